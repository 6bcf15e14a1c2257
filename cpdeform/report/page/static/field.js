// Fields on grids: the density of clay, whose level set is its surface, and the distance from the goal.

const CELLS_PER_SPACING = 0.8;
const LOOSE_LEVEL = 0.1;
const EMPTY_NODES = 4;

/**
 * The density of clay on a grid around it: the particles' mass shared out among the nodes, and blurred. Inside it is about 1.
 *
 * With `levels` (a byte for each particle) their mean at each node comes along.
 */
class Density {
  constructor(positions, spacing, levels) {
    const cell = (this.cell = spacing / CELLS_PER_SPACING);
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let place = 0; place < positions.length; place += 3) {
      for (let axis = 0; axis < 3; axis += 1) {
        const value = positions[place + axis];
        if (value < low[axis]) low[axis] = value;
        if (value > high[axis]) high[axis] = value;
      }
    }
    this.low = low.map((value) => value - EMPTY_NODES * cell);
    this.size = low.map((value, axis) => Math.ceil((high[axis] - value) / cell) + 2 * EMPTY_NODES + 1);
    this.stride = [this.size[1] * this.size[2], this.size[2], 1];
    const nodes = this.size[0] * this.stride[0];
    const mass = new Float32Array(nodes), weighted = levels ? new Float32Array(nodes) : null;
    const shares = [0, 0, 0];
    for (let particle = 0; 3 * particle < positions.length; particle += 1) {
      const base = this.locate(positions, 3 * particle, shares);
      for (let corner = 0; corner < 8; corner += 1) {
        const node = base + this.offset(corner), weight = cornerWeight(corner, shares) * CELLS_PER_SPACING ** 3;
        mass[node] += weight;
        if (weighted) weighted[node] += weight * levels[particle];
      }
    }
    this.values = this.blurred(mass);
    this.levels = weighted ? this.blurred(weighted) : null;
  }

  offset(corner) {
    return (corner & 4 ? this.stride[0] : 0) + (corner & 2 ? this.stride[1] : 0) + (corner & 1 ? this.stride[2] : 0);
  }

  /** The node below a place, and how far it is on the way to the next one along each axis. */
  locate(positions, at, shares) {
    let base = 0;
    for (let axis = 0; axis < 3; axis += 1) {
      const place = (positions[at + axis] - this.low[axis]) / this.cell;
      const whole = Math.floor(place);
      base += whole * this.stride[axis];
      shares[axis] = place - whole;
    }
    return base;
  }

  /** Twice a blur of weights 1/4, 1/2, 1/4 along each axis; the grid's rim is empty. */
  blurred(values) {
    let from = values, into = new Float32Array(values.length);
    for (let pass = 0; pass < 6; pass += 1) {
      const step = this.stride[pass % 3];
      for (let node = step; node < from.length - step; node += 1) into[node] = 0.25 * (from[node - step] + from[node + step]) + 0.5 * from[node];
      [from, into] = [into, from];
    }
    return from;
  }

  /** The gradient between the eight nodes around a place. */
  slope(base, shares, result) {
    result[0] = result[1] = result[2] = 0;
    for (let corner = 0; corner < 8; corner += 1) {
      const node = base + this.offset(corner), weight = cornerWeight(corner, shares);
      for (let axis = 0; axis < 3; axis += 1) {
        result[axis] += weight * (this.values[node + this.stride[axis]] - this.values[node - this.stride[axis]]);
      }
    }
    return result;
  }
}

function cornerWeight(corner, shares) {
  return (corner & 4 ? shares[0] : 1 - shares[0]) * (corner & 2 ? shares[1] : 1 - shares[1]) * (corner & 1 ? shares[2] : 1 - shares[2]);
}

/** Numbers of the particles that are crumbs: too few at their places for a surface. */
function looseParticles(positions, density) {
  const loose = [], shares = [0, 0, 0];
  for (let at = 0; at < positions.length; at += 3) {
    const base = density.locate(positions, at, shares);
    let value = 0;
    for (let corner = 0; corner < 8; corner += 1) value += cornerWeight(corner, shares) * density.values[base + density.offset(corner)];
    if (value < LOOSE_LEVEL) loose.push(at / 3);
  }
  return loose;
}

/** Normals of the clay's surface at all particles, as signed bytes; they are short inside, where the density does not fall off. */
function particleNormals(positions, density) {
  const normals = new Int8Array(positions.length);
  const shares = [0, 0, 0], slope = [0, 0, 0];
  for (let at = 0; at < positions.length; at += 3) {
    density.slope(density.locate(positions, at, shares), shares, slope);
    const scale = -127 / (Math.hypot(...slope) + 0.02);
    for (let axis = 0; axis < 3; axis += 1) normals[at + axis] = slope[axis] * scale;
  }
  return normals;
}

/** How far outside of the goal places are, in bytes of the field's range. */
function goalDistances(positions, field, nodes) {
  const result = new Uint8Array(positions.length / 3);
  const stride = [nodes * nodes, nodes, 1], shares = [0, 0, 0];
  for (let at = 0; at < positions.length; at += 3) {
    let base = 0, value = 0;
    for (let axis = 0; axis < 3; axis += 1) {
      const place = Math.min(Math.max(positions[at + axis], 0), 1) * (nodes - 1);
      const whole = Math.min(Math.floor(place), nodes - 2);
      base += whole * stride[axis];
      shares[axis] = place - whole;
    }
    for (let corner = 0; corner < 8; corner += 1) {
      const node = base + (corner & 4 ? stride[0] : 0) + (corner & 2 ? stride[1] : 0) + (corner & 1 ? 1 : 0);
      value += cornerWeight(corner, shares) * field[node];
    }
    result[at / 3] = Math.round(value);
  }
  return result;
}
