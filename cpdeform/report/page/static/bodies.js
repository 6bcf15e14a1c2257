// What moves in the view: clay, as a surface or as particles, and tools.

const CREASE = 0.6;

/** Clay at a moment. */
class Clay {
  constructor(content) {
    const { BufferAttribute, BufferGeometry, Mesh, Points, ShaderMaterial, Vector3 } = libraries;
    const { low, high } = content.bounds;
    this.spacing = content.spacing;
    this.uniforms = {
      pixels: { value: 1 }, radius: { value: 0.8 * content.spacing }, heights: { value: [low[1], high[1]] }, byHeight: { value: true },
      palette: { value: null }, light: { value: new Vector3() },
    };
    const material = (defines) => new ShaderMaterial({ vertexShader: CLAY_VERTEX, fragmentShader: CLAY_FRAGMENT, uniforms: this.uniforms, defines });
    this.particles = new Points(new BufferGeometry(), material({ BALLS: "" }));
    this.surface = new Mesh(new BufferGeometry(), material({}));
    const { geometry } = this.particles;
    geometry.setAttribute("position", new BufferAttribute(new Float32Array(3 * content.particles), 3));
    geometry.setAttribute("slope", new BufferAttribute(new Int8Array(3 * content.particles), 3, true));
    geometry.setAttribute("level", new BufferAttribute(new Uint8Array(content.particles), 1, true));
    for (const object of [this.particles, this.surface]) object.frustumCulled = false;
    this.asParticles = false;
  }

  /** Shows positions (lengths, Float32Array); `levels` gives a byte to each particle, `place` one to each place; null for neither. */
  show(positions, { levels, place }) {
    this.surface.visible = !this.asParticles;
    const density = new Density(positions, this.spacing, this.asParticles ? null : levels);
    const shown = this.asParticles ? null : looseParticles(positions, density);
    this.showParticles(positions, place ? place(positions) : levels, shown, density);
    if (!this.asParticles) this.showSurface(density, place);
  }

  /** Shows all particles, or those of the numbers in `shown`: crumbs that no surface shows. */
  showParticles(positions, levels, shown, density) {
    const { attributes } = this.particles.geometry;
    const pick = (values, size) => (shown === null ? values : values.constructor.from(shown.flatMap((at) => Array.from(values.subarray(size * at, size * at + size)))));
    const put = (name, values, size) => { attributes[name].array.set(pick(values, size)); attributes[name].needsUpdate = true; };
    put("position", positions, 3);
    put("slope", shown === null ? particleNormals(positions, density) : new Int8Array(positions.length), 3);
    if (levels) put("level", levels, 1);
    this.particles.geometry.setDrawRange(0, shown === null ? positions.length / 3 : shown.length);
  }

  showSurface(density, place) {
    const mesh = meshDensity(density);
    const { geometry } = this.surface;
    setAttribute(geometry, "position", mesh.positions, 3);
    setAttribute(geometry, "slope", mesh.normals, 3);
    setAttribute(geometry, "level", (place ? place(mesh.positions) : mesh.levels) ?? new Uint8Array(mesh.positions.length / 3), 1);
    setIndices(geometry, mesh.triangles);
  }

  showColours(stops, byHeight) {
    this.uniforms.palette.value?.dispose();
    this.uniforms.palette.value = paletteTexture(stops);
    this.uniforms.byHeight.value = byHeight;
  }
}

/** Room for this many numbers and some more, so that a mesh that grows needs no new buffer on the graphics card each time. */
const roomFor = (count) => 1 << Math.ceil(Math.log2(Math.max(count, 4)));

function setAttribute(geometry, name, values, size) {
  const { BufferAttribute } = libraries;
  let attribute = geometry.attributes[name];
  if (!attribute || attribute.array.length < values.length) {
    attribute = new BufferAttribute(new values.constructor(size * roomFor(values.length / size)), size, values instanceof Uint8Array);
    geometry.setAttribute(name, attribute);
  }
  attribute.array.set(values);
  attribute.needsUpdate = true;
}

function setIndices(geometry, triangles) {
  const { BufferAttribute } = libraries;
  if (!geometry.index || geometry.index.array.length < triangles.length) {
    geometry.setIndex(new BufferAttribute(new Uint32Array(roomFor(triangles.length)), 1));
  }
  geometry.index.array.set(triangles);
  geometry.index.needsUpdate = true;
  geometry.setDrawRange(0, triangles.length);
}

/** A tool: a grid of points or a mesh, turned and moved by its pose; one with a gap is a mixture of two grids. */
class Tool {
  constructor(description, surfaces, triangles, material) {
    const { BufferAttribute, BufferGeometry, Mesh, toCreasedNormals } = libraries;
    const { rows, columns } = description;
    this.points = 3 * description.points;
    this.surfaces = surfaces;
    this.count = description.surfaces;
    this.gap = NaN;
    this.makeGeometry = () => {
      const geometry = new BufferGeometry();
      geometry.setAttribute("position", new BufferAttribute(this.mixed(), 3));
      geometry.setIndex(triangles ? new BufferAttribute(triangles, 1) : gridTriangles(rows, columns));
      return toCreasedNormals(geometry, CREASE);
    };
    this.mesh = new Mesh(new BufferGeometry(), material);
  }

  mixed() {
    const result = this.surfaces.slice(0, this.points);
    if (this.count === 1) return result;
    for (let place = 0; place < this.points; place += 1) result[place] += this.gap * (this.surfaces[this.points + place] - result[place]);
    return result;
  }

  place(first, second, share) {
    const { Quaternion } = libraries;
    const mix = (at) => first[at] + share * (second[at] - first[at]);
    const turn = (pose) => new Quaternion(pose[4], pose[5], pose[6], pose[3]);
    this.mesh.position.set(mix(0), mix(1), mix(2));
    this.mesh.quaternion.copy(turn(first)).slerp(turn(second), share);
    const gap = mix(7);
    if (Number.isNaN(this.gap) || (this.count > 1 && gap !== this.gap)) {
      this.gap = gap;
      this.mesh.geometry.dispose();
      this.mesh.geometry = this.makeGeometry();
    }
  }
}

function gridTriangles(rows, columns) {
  const triangles = [];
  for (let row = 0; row + 1 < rows; row += 1) {
    for (let column = 0; column + 1 < columns; column += 1) {
      const at = row * columns + column;
      triangles.push(at, at + columns, at + 1, at + 1, at + columns, at + columns + 1);
    }
  }
  return triangles;
}
