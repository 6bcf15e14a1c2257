// Signed distances of the tools in their local frames, outward normals, and how these change. One point at a time: only nodes near a
// tool come here.
#pragma once

#include <cmath>

#include "scene.h"
#include "simd.h"

namespace CPDEFORM_ISA {

template <class Real>
struct Vector {
  Real x = 0, y = 0, z = 0;

  CPDEFORM_INLINE Vector operator+(const Vector& o) const { return {x + o.x, y + o.y, z + o.z}; }
  CPDEFORM_INLINE Vector operator-(const Vector& o) const { return {x - o.x, y - o.y, z - o.z}; }
  CPDEFORM_INLINE Vector operator*(Real s) const { return {s * x, s * y, s * z}; }
  CPDEFORM_INLINE Vector operator-() const { return {-x, -y, -z}; }
  CPDEFORM_INLINE void operator+=(const Vector& o) { *this = *this + o; }
  CPDEFORM_INLINE void operator-=(const Vector& o) { *this = *this - o; }
};

template <class Real>
CPDEFORM_INLINE Real dot(const Vector<Real>& a, const Vector<Real>& b) {
  return a.x * b.x + a.y * b.y + a.z * b.z;
}

template <class Real>
struct Matrix3 {
  Real m[3][3];
  CPDEFORM_INLINE Vector<Real> operator*(const Vector<Real>& v) const {
    return {m[0][0] * v.x + m[0][1] * v.y + m[0][2] * v.z, m[1][0] * v.x + m[1][1] * v.y + m[1][2] * v.z,
            m[2][0] * v.x + m[2][1] * v.y + m[2][2] * v.z};
  }
  CPDEFORM_INLINE Vector<Real> transposed(const Vector<Real>& v) const {
    return {m[0][0] * v.x + m[1][0] * v.y + m[2][0] * v.z, m[0][1] * v.x + m[1][1] * v.y + m[2][1] * v.z,
            m[0][2] * v.x + m[1][2] * v.y + m[2][2] * v.z};
  }
};

template <class Real>
struct Geometry {
  using P = Vector<Real>;

  // PlasticineLab's length: finite gradient at zero
  static constexpr Real length_regularization = Real(1e-8);

  CPDEFORM_INLINE static Real length(const P& v) { return std::sqrt(dot(v, v) + length_regularization); }
  CPDEFORM_INLINE static Real clamp(Real x, Real low, Real high) { return x < low ? low : (x > high ? high : x); }
  CPDEFORM_INLINE static Real sign(Real x) { return x < 0 ? Real(-1) : Real(1); }

  // Centre of the part of a tool that is nearest to a local point; zero but for chopsticks, which are the nearer of two capsules.
  static P part_centre(int kind, const Real* size, Real gap, const P& p) {
    if (kind != cpdeform::chopsticks) return {};
    return {Real(0.5) * gap * sign(p.x), Real(-0.5) * size[1], 0};
  }

  // The derivative of a distance's gradient is a symmetric matrix, the distance's Hessian: `bend` is its product with a direction, so
  // that the adjoint of the normal needs no function of its own. Where it is not used, the compiler leaves it out.
  struct Surface {
    P normal;
    Real distance;
    P bend;
    Real steepness = 1;  // length of the distance's gradient, which a mesh's interpolated one has near edges
  };

  CPDEFORM_INLINE static P across(const P& g, const P& normal) { return g - normal * dot(g, normal); }

  // Outward normal and signed distance at a local point p, and how the normal changes along g. All that kernels know of a kind.
  CPDEFORM_INLINE static Surface surface(int kind, const Real* size, const double* grid, const P& p, const P& g = {}) {
    switch (kind) {
      case cpdeform::sphere: {
        const Real r = length(p);
        const P normal = p * (1 / r);
        return {normal, r - size[0], across(g, normal) * (1 / r)};
      }
      case cpdeform::box: {
        const Real q[3] = {std::abs(p.x) - size[0], std::abs(p.y) - size[1], std::abs(p.z) - size[2]};
        int axis = q[1] > q[0] ? 1 : 0;
        if (q[2] > q[axis]) axis = 2;
        if (q[axis] > 0) {
          const P o = p - P{clamp(p.x, -size[0], size[0]), clamp(p.y, -size[1], size[1]), clamp(p.z, -size[2], size[2])};
          const P moved = {q[0] > 0 ? g.x : 0, q[1] > 0 ? g.y : 0, q[2] > 0 ? g.z : 0};
          const Real r = std::sqrt(dot(o, o));
          const P normal = o * (1 / r);
          return {normal, r - size[3], across(moved, normal) * (1 / r)};
        }
        P normal;
        (axis == 0 ? normal.x : axis == 1 ? normal.y : normal.z) = sign(axis == 0 ? p.x : axis == 1 ? p.y : p.z);
        return {normal, q[axis] - size[3], {}};
      }
      case cpdeform::cylinder: {
        const Real r = std::sqrt(p.x * p.x + p.z * p.z + length_regularization);
        const P out = {p.x / r, 0, p.z / r}, up = {0, sign(p.y), 0};
        const P turn = across(P{g.x, 0, g.z}, out) * (1 / r);
        const Real side = r - size[0], top = std::abs(p.y) - size[1];
        if (side > 0 && top > 0) {
          const Real distance = std::sqrt(side * side + top * top);
          const P normal = out * (side / distance) + up * (top / distance);
          const Real moved_side = dot(g, out), moved_top = dot(g, up);
          const P moved = out * moved_side + up * moved_top + turn * side;
          return {normal, distance, (moved - normal * ((side * moved_side + top * moved_top) / distance)) * (1 / distance)};
        }
        return side > top ? Surface{out, side, turn} : Surface{up, top, {}};
      }
      case cpdeform::torus: {
        const Real r = std::sqrt(p.x * p.x + p.z * p.z + length_regularization);
        const P out = {p.x / r, 0, p.z / r};
        const Real side = r - size[0];
        const P q = {side * out.x, p.y, side * out.z};
        const P moved = out * dot(g, out) + across(P{g.x, 0, g.z}, out) * (side / r) + P{0, g.y, 0};
        const Real s = length(q);
        const P normal = q * (1 / s);
        return {normal, s - size[1], across(moved, normal) * (1 / s)};
      }
      case cpdeform::capsule:
      case cpdeform::rolling_pin:
      case cpdeform::chopsticks: {
        const Real h = Real(0.5) * size[1];
        const P q = {p.x, p.y - clamp(p.y, -h, h), p.z};
        const P moved = {g.x, std::abs(p.y) < h ? 0 : g.y, g.z};
        const Real r = length(q);
        const P normal = q * (1 / r);
        return {normal, r - size[0], across(moved, normal) * (1 / r)};
      }
      case cpdeform::mesh:
        return mesh_surface(size, grid, p, g);
    }
    cpdeform::throw_unknown_tool(kind);
  }

  // The signed distance to the nearest of some triangles, the normal there, and how it changes along g. `list` is the number of
  // triangles and where the numbers of each are (see triangles.py), counted from `numbers`.
  static Surface triangles_surface(const double* numbers, const double* list, const P& p, const P& g) {
    Real least = Real(1e30);
    P way, mean, edge;  // from the nearest place, the mean normal there, and along its edge; no edge on a face or at a corner
    bool face = false;
    for (int n = 1; n <= int(list[0]); ++n) {
      const double* t = numbers + int64_t(list[n]);
      const P normal = vector(t + 9);
      P offset[3], along[3];
      bool inside = true;
      for (int i = 0; i < 3; ++i) {
        const P corner = vector(t + 3 * i);
        offset[i] = p - corner;
        along[i] = vector(t + 3 * ((i + 1) % 3)) - corner;
        inside = inside && dot(cross(normal, along[i]), offset[i]) >= 0;
      }
      if (inside) {
        const Real height = dot(offset[0], normal);
        if (height * height < least) {
          least = height * height;
          way = normal * height;
          mean = normal;
          face = true;
        }
        continue;
      }
      for (int i = 0; i < 3; ++i) {
        const Real share = clamp(dot(offset[i], along[i]) / dot(along[i], along[i]), 0, 1);
        const P from = offset[i] - along[i] * share;
        if (dot(from, from) < least) {
          least = dot(from, from);
          way = from;
          mean = vector(t + (share <= 0 ? 21 + 3 * i : share >= 1 ? 21 + 3 * ((i + 1) % 3) : 12 + 3 * i));
          edge = share > 0 && share < 1 ? along[i] * (1 / std::sqrt(dot(along[i], along[i]))) : P{};
          face = false;
        }
      }
    }
    if (face) return {mean, dot(way, mean), {}};
    const Real length = std::sqrt(least), distance = dot(way, mean) < 0 ? -length : length;
    if (length < Real(1e-7)) return {mean, distance, {}};
    const P normal = way * (1 / distance);
    return {normal, distance, across(g - edge * dot(g, edge), normal) * (1 / distance)};
  }

  CPDEFORM_INLINE static P vector(const double* from) { return {Real(from[0]), Real(from[1]), Real(from[2])}; }
  CPDEFORM_INLINE static P cross(const P& a, const P& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
  }

  // The quadratic B-spline of a mesh's signed distance, its normalised gradient, and the change of that along g. Beyond the grid, the
  // distance at its nearest point and the way there. At sharp edges, the distance to triangles.
  static Surface mesh_surface(const Real* size, const double* grid, const P& p, const P& g) {
    const Real at[3] = {p.x, p.y, p.z};
    Real weight[3][3], slope[3][3], beyond = 0;
    int count[3], base[3];
    for (int a = 0; a < 3; ++a) {
      count[a] = int(size[1 + a]);
      const Real u = at[a] / size[0] + Real(0.5) * Real(count[a] - 1);
      // not a number goes to the first node
      const Real inside = u > 1 ? (u < Real(count[a] - 2) ? u : Real(count[a] - 2)) : Real(1);
      beyond += (u - inside) * (u - inside);
      base[a] = int(inside + Real(0.5));
      if (base[a] > count[a] - 2) base[a] = count[a] - 2;
      const Real f = inside - Real(base[a]), low = Real(0.5) - f, high = Real(0.5) + f;
      weight[a][0] = Real(0.5) * low * low;
      weight[a][1] = Real(0.75) - f * f;
      weight[a][2] = Real(0.5) * high * high;
      slope[a][0] = -low;
      slope[a][1] = -2 * f;
      slope[a][2] = high;
    }
    const int64_t nodes = int64_t(count[0]) * count[1] * count[2];
    const double* lists = grid + 2 * nodes;
    const double list = grid[nodes + (int64_t(base[0]) * count[1] + base[1]) * count[2] + base[2]];
    if (list > 0) return triangles_surface(lists, lists + int64_t(list), p, g);
    const Real curve[3] = {1, -2, 1};
    Real distance = 0;
    P gradient, straight, mixed;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        for (int k = 0; k < 3; ++k) {
          const int64_t node = (int64_t(base[0] + i - 1) * count[1] + base[1] + j - 1) * count[2] + base[2] + k - 1;
          const Real c = Real(grid[node]);
          const Real x = weight[0][i], y = weight[1][j], z = weight[2][k], dx = slope[0][i], dy = slope[1][j], dz = slope[2][k];
          distance += c * x * y * z;
          gradient += P{dx * y * z, x * dy * z, x * y * dz} * c;
          straight += P{curve[i] * y * z, x * curve[j] * z, x * y * curve[k]} * c;
          mixed += P{dx * dy * z, dx * y * dz, x * dy * dz} * c;
        }
    const Real steep = std::sqrt(dot(gradient, gradient)) / size[0], scale = steep > Real(1e-3) ? 1 / steep : Real(1e3);
    const P normal = gradient * (scale / size[0]);
    // The transposed derivative of the normal: an interpolated distance's Hessian does not vanish along the normal.
    const P a = across(g, normal);
    const P bend = {straight.x * a.x + mixed.x * a.y + mixed.y * a.z, mixed.x * a.x + straight.y * a.y + mixed.z * a.z,
                    mixed.y * a.x + mixed.z * a.y + straight.z * a.z};
    return {normal, distance + std::sqrt(beyond) * size[0], bend * (scale / (size[0] * size[0])), steep};
  }

  // Half extents of a box around a tool in its local frame, and that box's centre.
  static void extents(int kind, const Real* size, Real gap, Real (&half)[3], Real (&centre)[3]) {
    centre[0] = centre[1] = centre[2] = 0;
    switch (kind) {
      case cpdeform::sphere:
        half[0] = half[1] = half[2] = size[0];
        return;
      case cpdeform::box:
        for (int a = 0; a < 3; ++a) half[a] = size[a] + size[3];
        return;
      case cpdeform::cylinder:
        half[0] = half[2] = size[0];
        half[1] = size[1];
        return;
      case cpdeform::torus:
        half[0] = half[2] = size[0] + size[1];
        half[1] = size[1];
        return;
      case cpdeform::chopsticks:
        half[0] = std::abs(Real(0.5) * gap) + size[0];
        half[1] = Real(0.5) * size[1] + size[0];
        half[2] = size[0];
        centre[1] = Real(-0.5) * size[1];
        return;
      case cpdeform::capsule:
      case cpdeform::rolling_pin:
        half[0] = half[2] = size[0];
        half[1] = Real(0.5) * size[1] + size[0];
        return;
      case cpdeform::mesh:
        for (int a = 0; a < 3; ++a) half[a] = Real(0.5) * size[0] * (size[1 + a] - 1);
        return;
    }
    cpdeform::throw_unknown_tool(kind);
  }
};

}  // namespace CPDEFORM_ISA
