// Where the content comes from: the page itself, or the server that it was loaded from while the run goes on.

const LIVE = find("content") === null;
const QUANTA = 65535;

async function loadContent() {
  if (!LIVE) return JSON.parse(find("content").textContent);
  const answer = await fetch("content.json", { cache: "no-store" });
  if (!answer.ok) throw new Error((await answer.text()) || `the server answered ${answer.status}`);
  return answer.json();
}

/** The bytes of an array, unpacked. */
async function loadBytes(name) {
  let packed;
  if (LIVE) {
    const answer = await fetch(`arrays/${encodeURIComponent(name)}`, { cache: "no-store" });
    if (!answer.ok) throw new Error(`the server has no ${name}`);
    packed = await answer.arrayBuffer();
  } else {
    const text = find(name).textContent;
    packed = Uint8Array.fromBase64 ? Uint8Array.fromBase64(text) : Uint8Array.from(atob(text), (sign) => sign.charCodeAt(0));
  }
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

const loadFloats = async (name) => new Float32Array((await loadBytes(name)).buffer);
const loadShorts = async (name) => new Uint16Array((await loadBytes(name)).buffer);
const loadIndices = async (name) => new Uint32Array((await loadBytes(name)).buffer);

/** Positions of all frames, each a Uint16Array of x, y, z of one particle after the other; see encoding.py. */
function decodeFrames(bytes, particles) {
  const size = 3 * particles;
  const plane = bytes.length / 3;
  const frames = [];
  const rate = new Int32Array(size);
  for (let frame = 0, at = 0; at < plane; frame += 1) {
    const positions = new Uint16Array(size);
    const before = frame > 0 ? frames[frame - 1] : null;
    for (let axis = 0; axis < 3; axis += 1) {
      let neighbour = 0;
      for (let place = axis; place < size; place += 3, at += 1) {
        const even = bytes[at] | (bytes[plane + at] << 8) | (bytes[2 * plane + at] << 16);
        const change = (even >>> 1) ^ -(even & 1);
        if (frame === 0) {
          neighbour += change;
          positions[place] = neighbour;
        } else {
          rate[place] += change;
          positions[place] = before[place] + rate[place];
        }
      }
    }
    frames.push(positions);
  }
  return frames;
}
