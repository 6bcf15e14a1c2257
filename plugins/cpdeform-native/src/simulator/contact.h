// A node's velocity under contact with one tool, walls and floor, and the adjoints.
#pragma once

#include "frame.h"
#include "geometry.h"

namespace CPDEFORM_ISA {

// R(q) = I + 2 w [u] + 2 [u]^2, and the pull-back of a matrix gradient to the quaternion.
inline void rotation_of(const double* q, double (&r)[3][3]) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  const double m[3][3] = {{1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)},
                          {2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)},
                          {2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)}};
  std::memcpy(r, m, sizeof(m));
}

inline void rotation_adjoint(const double* q, const double (&g)[3][3], double* grad) {
  const double w = q[0], x = q[1], y = q[2], z = q[3];
  grad[0] += 2 * (x * (g[2][1] - g[1][2]) + y * (g[0][2] - g[2][0]) + z * (g[1][0] - g[0][1]));
  grad[1] += 2 * (y * (g[0][1] + g[1][0]) + z * (g[0][2] + g[2][0]) + w * (g[2][1] - g[1][2])) - 4 * x * (g[1][1] + g[2][2]);
  grad[2] += 2 * (x * (g[0][1] + g[1][0]) + z * (g[1][2] + g[2][1]) + w * (g[0][2] - g[2][0])) - 4 * y * (g[0][0] + g[2][2]);
  grad[3] += 2 * (x * (g[0][2] + g[2][0]) + y * (g[1][2] + g[2][1]) + w * (g[1][0] - g[0][1])) - 4 * z * (g[0][0] + g[1][1]);
}

// One tool during one substep. Differences of poses are taken in double before they lose digits.
template <class Real>
struct ToolMotion {
  int kind;
  Real size[4];
  const double* grid;
  Real friction, gap;
  Vector<Real> position;   // before
  Vector<Real> velocity;   // of the position
  Matrix3<Real> rotation;  // before
  Matrix3<Real> spin;      // (rotation after - rotation before) / dt
  int low[3], high[3];     // nodes outside are not touched

  static ToolMotion make(const cpdeform::Tool& tool, const double* before, const double* after, const cpdeform::Scene& scene) {
    ToolMotion t;
    t.kind = tool.kind;
    for (int i = 0; i < 4; ++i) t.size[i] = Real(tool.size[i]);
    t.grid = tool.grid;
    t.friction = Real(tool.friction);
    t.gap = Real(before[7]);
    t.position = {Real(before[0]), Real(before[1]), Real(before[2])};
    const double rate = 1.0 / scene.time_step;
    t.velocity = {Real((after[0] - before[0]) * rate), Real((after[1] - before[1]) * rate), Real((after[2] - before[2]) * rate)};
    double r0[3][3], r1[3][3];
    rotation_of(before + 3, r0);
    rotation_of(after + 3, r1);
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) {
        t.rotation.m[i][j] = Real(r0[i][j]);
        t.spin.m[i][j] = Real((r1[i][j] - r0[i][j]) * rate);
      }
    Real half[3], centre[3];
    Geometry<Real>::extents(t.kind, t.size, t.gap, half, centre);
    // the smoothed lengths of the distances are off by 1e-4
    const double reach = 2e-4 + (scene.softness > 0 ? 2.302585093 / scene.softness : 0.0);
    for (int i = 0; i < 3; ++i) {
      double middle = before[i], extent = reach;
      for (int j = 0; j < 3; ++j) {
        middle += r0[i][j] * centre[j];
        extent += std::abs(r0[i][j]) * half[j];
      }
      const double low = (middle - extent) / scene.node_distance, high = (middle + extent) / scene.node_distance;
      const double last = scene.grid_size;
      t.low[i] = low > 0 ? (low < last ? int(std::ceil(low)) : scene.grid_size) : 0;
      t.high[i] = high < last ? (high > 0 ? int(std::floor(high)) : -1) : scene.grid_size - 1;
      // not a number: near every node, so that it spreads as in a node-by-node test
      if (!(low <= high)) {
        t.low[i] = 0;
        t.high[i] = scene.grid_size - 1;
      }
    }
    return t;
  }

  CPDEFORM_INLINE bool near(int i, int j, int k) const {
    return i >= low[0] && i <= high[0] && j >= low[1] && j <= high[1] && k >= low[2] && k <= high[2];
  }
  CPDEFORM_INLINE bool near_row(int i, int j) const { return i >= low[0] && i <= high[0] && j >= low[1] && j <= high[1]; }
};

// Gradient with respect to a tool's two poses of one substep, summed over nodes.
struct ToolGradient {
  double position_before[3], position_after[3];
  double rotation_before[3][3], rotation_after[3][3];
  double gap;
};

template <class Real>
struct Contact {
  using P = Vector<Real>;
  using G = Geometry<Real>;
  using Motion = ToolMotion<Real>;
  static constexpr Real norm_regularization = Real(1e-8);

  // Share of the contact velocity at a node; 0 where there is no contact.
  CPDEFORM_INLINE static Real influence(Real softness, Real distance) {
    if (softness > 0) {
      const Real k = std::exp(-softness * distance);
      return k <= Real(0.1) ? Real(0) : (k > 1 ? Real(1) : k);
    }
    return distance <= 0 ? Real(1) : Real(0);
  }

  static P apply(const Motion& tool, Real softness, const P& node, const P& velocity) {
    const P local = tool.rotation.transposed(node - tool.position);
    const P centre = G::part_centre(tool.kind, tool.size, tool.gap, local);
    const typename G::Surface s = G::surface(tool.kind, tool.size, tool.grid, local - centre);
    const Real k = influence(softness, s.distance);
    if (!(k > 0)) return velocity;
    const P normal = tool.rotation * s.normal;
    const P vc = tool.velocity + tool.spin * local;
    const P u = velocity - vc;
    const Real un = dot(u, normal);
    P t = u;
    if (un < 0) {
      const P along = u - normal * un;
      const Real norm = std::sqrt(dot(along, along) + norm_regularization);
      const Real left = norm + tool.friction * un;
      t = along * ((left > 0 ? left : Real(0)) / norm);
    }
    return vc + u * (1 - k) + t * k;
  }

  CPDEFORM_INLINE static void add_outer(double (&m)[3][3], const P& a, const P& b) {
    const Real x[3] = {a.x, a.y, a.z}, y[3] = {b.x, b.y, b.z};
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) m[i][j] += double(x[i]) * y[j];
  }
  CPDEFORM_INLINE static void add(double (&v)[3], const P& a) {
    v[0] += a.x;
    v[1] += a.y;
    v[2] += a.z;
  }

  // Gradient with respect to the velocity before contact; adds those of both poses to `gradient`.
  static P adjoint(const Motion& tool, Real softness, Real time_step, const P& node, const P& velocity, const P& g,
                   ToolGradient& gradient) {
    const P offset = node - tool.position;
    const P local = tool.rotation.transposed(offset);
    const P centre = G::part_centre(tool.kind, tool.size, tool.gap, local);
    const typename G::Surface s = G::surface(tool.kind, tool.size, tool.grid, local - centre);
    const Real k = influence(softness, s.distance);
    if (!(k > 0)) return g;
    const P normal = tool.rotation * s.normal;
    const P vc = tool.velocity + tool.spin * local;
    const P u = velocity - vc;
    const Real un = dot(u, normal);
    P t = u, gt = g * k, gu = g * (1 - k), gn;
    if (un < 0) {
      const P along = u - normal * un;
      const Real norm = std::sqrt(dot(along, along) + norm_regularization);
      const Real left = norm + tool.friction * un;
      Real gun = 0;
      P ga;
      t = P{};
      if (left > 0) {
        const Real ratio = left / norm;
        t = along * ratio;
        const Real pull = dot(gt, along) / norm;
        // ratio = 1 + friction un / norm
        ga = gt * ratio - along * (pull * tool.friction * un / (norm * norm));
        gun = pull * tool.friction;
      }
      gu += ga;
      gun -= dot(ga, normal);
      gn -= ga * un;
      gu += normal * gun;
      gn += u * gun;
    } else {
      gu += gt;
    }
    const Real gk = dot(g, t - u);
    // the tool's velocity at the node
    const P gvc = g - gu;
    const P rate = gvc * (1 / time_step);
    add(gradient.position_after, rate);
    add(gradient.position_before, -rate);
    add_outer(gradient.rotation_after, rate, local);
    add_outer(gradient.rotation_before, -rate, local);
    P gl = tool.spin.transposed(gvc);
    // normal and influence
    add_outer(gradient.rotation_before, gn, s.normal);
    P gs = G::surface(tool.kind, tool.size, tool.grid, local - centre, tool.rotation.transposed(gn)).bend;
    if (softness > 0 && s.distance > 0) gs -= s.normal * (gk * softness * k * s.steepness);
    gl += gs;
    if (tool.kind == cpdeform::chopsticks) gradient.gap += Real(0.5) * (local.x >= 0 ? -gs.x : gs.x);
    // local = R^T (node - position)
    add_outer(gradient.rotation_before, offset, gl);
    add(gradient.position_before, -(tool.rotation * gl));
    return gu;
  }
};

// Walls and floor.
template <class Real>
struct Boundary {
  using P = Vector<Real>;
  Real friction;
  int ground_nodes, wall_nodes, grid_size;
  static constexpr Real sticky_friction = Real(10);
  static constexpr Real norm_regularization = Real(1e-8);

  CPDEFORM_INLINE bool blocks(int i, Real v) const { return (i < wall_nodes && v < 0) || (i > grid_size - wall_nodes && v > 0); }

  // Whether any velocity could be changed at these nodes.
  CPDEFORM_INLINE bool touches(int i, int j, int low, int high) const {
    return i < wall_nodes || i > grid_size - wall_nodes || j < ground_nodes || j > grid_size - wall_nodes || low < wall_nodes ||
           high > grid_size - wall_nodes;
  }

  CPDEFORM_INLINE Real slip(const P& v) const {
    const Real norm = std::sqrt(v.x * v.x + v.z * v.z + norm_regularization);
    const Real factor = 1 + friction * v.y / norm;
    return factor > 0 ? factor : Real(0);
  }

  P apply(int i, int j, int k, P v) const {
    if (blocks(i, v.x)) v.x = 0;
    if (j < ground_nodes && v.y < 0) {
      if (friction >= sticky_friction) {
        v = P{};
      } else {
        const Real factor = friction > 0 ? slip(v) : Real(1);
        v = {factor * v.x, 0, factor * v.z};
      }
    }
    if (j > grid_size - wall_nodes && v.y > 0) v.y = 0;
    if (blocks(k, v.z)) v.z = 0;
    return v;
  }

  P adjoint(int i, int j, int k, P v, P g) const {
    const bool stopped = blocks(i, v.x);
    if (stopped) v.x = 0;
    const bool floor = j < ground_nodes && v.y < 0;
    P after = v;
    Real factor = 1;
    if (floor) {
      if (friction > 0) factor = slip(v);
      after = friction >= sticky_friction ? P{} : P{factor * v.x, 0, factor * v.z};
    }
    if (blocks(k, after.z)) g.z = 0;
    if (j > grid_size - wall_nodes && after.y > 0) g.y = 0;
    if (floor) {
      if (friction >= sticky_friction) {
        g = P{};
      } else {
        const Real along = g.x * v.x + g.z * v.z;
        g = {factor * g.x, 0, factor * g.z};
        if (friction > 0 && factor > 0) {
          // factor = 1 + friction v_y / norm
          const Real norm = std::sqrt(v.x * v.x + v.z * v.z + norm_regularization);
          const Real pull = friction / norm;
          const Real bend = -along * pull * v.y / (norm * norm);
          g = {g.x + bend * v.x, along * pull, g.z + bend * v.z};
        }
      }
    }
    if (stopped) g.x = 0;
    return g;
  }
};

}  // namespace CPDEFORM_ISA
