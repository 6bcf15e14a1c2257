// The surface of clay as a mesh: naive surface nets (Gibson, 1998), a corner in each cell that the surface goes through.

const SURFACE_LEVEL = 0.5;
const CELL_EDGES = [[0, 1], [0, 2], [0, 4], [1, 3], [1, 5], [2, 3], [2, 6], [3, 7], [4, 5], [4, 6], [5, 7], [6, 7]];

/**
 * Meshes a density.
 *
 * Returns positions, normals (three numbers a corner), levels (a byte a corner, or null) and triangles.
 */
function meshDensity(density) {
  const { size, stride, values, low, cell } = density;
  const corners = new Int32Array(values.length).fill(-1);
  const positions = [], normals = [], levels = density.levels ? [] : null;
  const shares = [0, 0, 0], slope = [0, 0, 0], place = [0, 0, 0];
  for (let x = 1; x < size[0] - 2; x += 1) {
    for (let y = 1; y < size[1] - 2; y += 1) {
      let node = x * stride[0] + y * stride[1] + 1;
      for (let z = 1; z < size[2] - 2; z += 1, node += 1) {
        let inside = 0;
        for (let corner = 0; corner < 8; corner += 1) if (values[node + density.offset(corner)] > SURFACE_LEVEL) inside += 1;
        if (inside === 0 || inside === 8) continue;
        crossing(density, node, shares);
        corners[node] = positions.length / 3;
        place[0] = x; place[1] = y; place[2] = z;
        density.slope(node, shares, slope);
        const length = -1 / (Math.hypot(...slope) + 1e-9);
        for (let axis = 0; axis < 3; axis += 1) {
          positions.push(low[axis] + (place[axis] + shares[axis]) * cell);
          normals.push(slope[axis] * length);
        }
        if (levels) levels.push(levelAt(density, node, shares));
      }
    }
  }
  return { positions: new Float32Array(positions), normals: new Float32Array(normals), levels: levels && new Uint8Array(levels), triangles: netTriangles(density, corners) };
}

/** The mean of where the surface crosses the edges of a cell, as shares of its edges. */
function crossing(density, node, shares) {
  shares[0] = shares[1] = shares[2] = 0;
  let count = 0;
  for (const [first, second] of CELL_EDGES) {
    const a = density.values[node + density.offset(first)], b = density.values[node + density.offset(second)];
    if (a > SURFACE_LEVEL === b > SURFACE_LEVEL) continue;
    const share = (SURFACE_LEVEL - a) / (b - a);
    for (let axis = 0, bit = 4; axis < 3; axis += 1, bit >>= 1) shares[axis] += (first & bit ? 1 : 0) * (1 - share) + (second & bit ? 1 : 0) * share;
    count += 1;
  }
  for (let axis = 0; axis < 3; axis += 1) shares[axis] /= count;
}

function levelAt(density, node, shares) {
  let mass = 0, level = 0;
  for (let corner = 0; corner < 8; corner += 1) {
    const weight = cornerWeight(corner, shares), place = node + density.offset(corner);
    mass += weight * density.values[place];
    level += weight * density.levels[place];
  }
  return Math.round(level / Math.max(mass, 1e-6));
}

/** Two triangles around each edge of the grid that the surface crosses, between the four cells about it. */
function netTriangles(density, corners) {
  const { size, stride, values } = density;
  const triangles = [];
  for (let x = 1; x < size[0] - 2; x += 1) {
    for (let y = 1; y < size[1] - 2; y += 1) {
      let node = x * stride[0] + y * stride[1] + 1;
      for (let z = 1; z < size[2] - 2; z += 1, node += 1) {
        if (corners[node] < 0) continue;
        for (let axis = 0; axis < 3; axis += 1) {
          const inside = values[node] > SURFACE_LEVEL;
          if (inside === values[node + stride[axis]] > SURFACE_LEVEL) continue;
          const u = stride[(axis + 1) % 3], v = stride[(axis + 2) % 3];
          const a = corners[node], b = corners[node - u], c = corners[node - u - v], d = corners[node - v];
          if (inside) triangles.push(a, b, c, a, c, d);
          else triangles.push(a, c, b, a, d, c);
        }
      }
    }
  }
  return new Uint32Array(triangles);
}
