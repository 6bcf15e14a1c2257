// How clay is drawn: as a surface, or as particles, which are balls that lean towards the slope of the clay's surface.

const CLAY_VERTEX = `
  attribute vec3 slope;
  attribute float level;
  uniform float radius;
  uniform float pixels;
  uniform vec2 heights;
  uniform bool byHeight;
  varying vec3 vSlope;
  varying float vLevel;
  void main() {
    vec4 seen = modelViewMatrix * vec4(position, 1.0);
    gl_Position = projectionMatrix * seen;
    gl_PointSize = max(2.0, 2.0 * radius * pixels / -seen.z);
    vSlope = (modelViewMatrix * vec4(slope, 0.0)).xyz;
    vLevel = byHeight ? clamp((position.y - heights.x) / max(heights.y - heights.x, 1e-6), 0.0, 1.0) : level;
  }
`;

const CLAY_FRAGMENT = `
  precision mediump float;
  uniform sampler2D palette;
  uniform vec3 light;
  varying vec3 vSlope;
  varying float vLevel;
  void main() {
    #ifdef BALLS
    vec2 across = 2.0 * gl_PointCoord - 1.0;
    float reach = dot(across, across);
    if (reach > 1.0) discard;
    vec3 normal = normalize(vSlope + 0.5 * vec3(across.x, -across.y, sqrt(1.0 - reach)));
    #else
    vec3 normal = normalize(vSlope);
    #endif
    vec3 base = texture2D(palette, vec2(vLevel * 0.996 + 0.002, 0.5)).rgb;
    float shade = max(dot(normal, light), 0.0);
    float rim = 0.86 + 0.14 * clamp(normal.z, 0.0, 1.0);
    gl_FragColor = vec4(base * (0.42 + 0.66 * shade) * rim, 1.0);
  }
`;

const SOLID_VERTEX = `
  varying vec3 vNormal;
  void main() {
    gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
    vNormal = normalMatrix * normal;
  }
`;

const SOLID_FRAGMENT = `
  precision mediump float;
  uniform vec3 colour;
  uniform float opacity;
  uniform vec3 light;
  varying vec3 vNormal;
  void main() {
    float shade = max(dot(normalize(vNormal), light), 0.0);
    gl_FragColor = vec4(colour * (0.62 + 0.6 * shade), opacity);
  }
`;

/** The material of tools and goal: one colour that one sees through. It has its light from the clay's uniforms. */
function solidMaterial(colour, opacity, { light }) {
  const { ShaderMaterial, Vector3 } = libraries;
  const [red, green, blue] = [16, 8, 0].map((shift) => ((colour >> shift) & 255) / 255);
  const uniforms = { colour: { value: new Vector3(red, green, blue) }, opacity: { value: opacity }, light };
  return new ShaderMaterial({ vertexShader: SOLID_VERTEX, fragmentShader: SOLID_FRAGMENT, uniforms, transparent: true });
}

const PALETTE_SIZE = 256;

/** A texture of a row of colours between the stops. */
function paletteTexture(stops) {
  const { DataTexture, LinearFilter, RGBAFormat } = libraries;
  const colours = stops.map((stop) => [1, 3, 5].map((at) => parseInt(stop.slice(at, at + 2), 16)));
  const data = new Uint8Array(4 * PALETTE_SIZE);
  for (let place = 0; place < PALETTE_SIZE; place += 1) {
    const at = (place / (PALETTE_SIZE - 1)) * (colours.length - 1);
    const lower = Math.min(Math.floor(at), colours.length - 2);
    for (let channel = 0; channel < 3; channel += 1) {
      data[4 * place + channel] = colours[lower][channel] + (at - lower) * (colours[lower + 1][channel] - colours[lower][channel]);
    }
    data[4 * place + 3] = 255;
  }
  const texture = new DataTexture(data, PALETTE_SIZE, 1, RGBAFormat);
  texture.magFilter = texture.minFilter = LinearFilter;
  texture.needsUpdate = true;
  return texture;
}
