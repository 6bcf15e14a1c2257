// The grid's passes over layers of nodes: momenta to velocities (gravity, tools, walls, floor), and the adjoint.
#pragma once

#include "contact.h"
#include "frame.h"
#include "profile.h"

namespace CPDEFORM_ISA {

template <class Real>
struct GridPass {
  using P = Vector<Real>;
  using Motion = ToolMotion<Real>;
  typedef Real Node __attribute__((vector_size(4 * sizeof(Real)), aligned(sizeof(Real)), may_alias));
  static constexpr Real smallest_mass = Real(1e-12);

  Real time_step, node_distance, softness;
  P impulse;  // gravity over a substep
  Boundary<Real> boundary;

  explicit GridPass(const cpdeform::Scene& scene)
      : time_step(Real(scene.time_step)),
        node_distance(Real(scene.node_distance)),
        softness(Real(scene.softness)),
        impulse{Real(scene.gravity[0] * scene.time_step), Real(scene.gravity[1] * scene.time_step),
                Real(scene.gravity[2] * scene.time_step)},
        boundary{Real(scene.ground_friction), scene.ground_nodes, scene.wall_nodes, scene.grid_size} {}

  // Sum layers [first, last) of the parts, whose boxes lie inside that of `total`.
  static void sum(const Grid<Real>& total, const Grid<Real>* parts, int count, int first, int last) {
    cpdeform::Stopwatch watch(cpdeform::Phase::grid);
    const Box& box = total.box;
    const int64_t layer = 4 * box.layer(), line = 4 * box.size(2);
    for (int i = first; i < last; ++i) {
      Real* target = total.nodes + (i - box.low[0]) * layer;
      for (int64_t n = 0; n < layer; ++n) target[n] = 0;
      for (int t = 0; t < count; ++t) {
        const Grid<Real>& part = parts[t];
        if (i < part.box.low[0] || i > part.box.high[0]) continue;
        const int64_t width = 4 * part.box.size(2);
        for (int j = part.box.low[1]; j <= part.box.high[1]; ++j) {
          const Real* from = part.nodes + 4 * (i - part.box.low[0]) * part.box.layer() + (j - part.box.low[1]) * width;
          Real* to = target + (j - box.low[1]) * line + 4 * (part.box.low[2] - box.low[2]);
          for (int64_t n = 0; n < width; ++n) to[n] += from[n];
        }
      }
    }
  }

  CPDEFORM_INLINE P position(int i, int j, int k) const {
    return {Real(i) * node_distance, Real(j) * node_distance, Real(k) * node_distance};
  }

  // Velocities of layers [first, last) of a box from momentum and mass.
  void update(const Grid<Real>& momentum, Real* velocity, const Motion* tools, int tool_count, int first, int last) const {
    cpdeform::Stopwatch watch(cpdeform::Phase::grid);
    const Box& box = momentum.box;
    const int width = box.size(2);
    const Node push = {impulse.x, impulse.y, impulse.z, 0};
    for (int i = first; i < last; ++i)
      for (int j = box.low[1]; j <= box.high[1]; ++j) {
        const int64_t row = ((i - box.low[0]) * int64_t(box.size(1)) + (j - box.low[1])) * width;
        const Real* from = momentum.nodes + 4 * row;
        Real* to = velocity + 4 * row;
        for (int k = 0; k < width; ++k) {
          const Node node = *reinterpret_cast<const Node*>(from + 4 * k);
          const Real mass = node[3];
          Node v = {};
          if (mass > smallest_mass) v = node * (1 / mass) + push;
          v[3] = 0;
          *reinterpret_cast<Node*>(to + 4 * k) = v;
        }
        bool special = boundary.touches(i, j, box.low[2], box.high[2]);
        for (int m = 0; m < tool_count; ++m) special |= tools[m].near_row(i, j);
        if (!special) continue;
        watch.change(cpdeform::Phase::tools);
        for (int k = 0; k < width; ++k) {
          if (!(from[4 * k + 3] > smallest_mass)) continue;
          P v = {to[4 * k], to[4 * k + 1], to[4 * k + 2]};
          v = through_tools(tools, tool_count, i, j, k + box.low[2], v);
          v = boundary.apply(i, j, k + box.low[2], v);
          to[4 * k] = v.x;
          to[4 * k + 1] = v.y;
          to[4 * k + 2] = v.z;
        }
        watch.change(cpdeform::Phase::grid);
      }
  }

  CPDEFORM_INLINE P through_tools(const Motion* tools, int count, int i, int j, int k, P v) const {
    for (int m = 0; m < count; ++m)
      if (tools[m].near(i, j, k)) v = Contact<Real>::apply(tools[m], softness, position(i, j, k), v);
    return v;
  }

  // Turns the gradient of the velocities in layers [first, last) of `gradient` into that of momentum and mass; the boxes are equal.
  void adjoint(const Grid<Real>& momentum, const Grid<Real>& gradient, const Motion* tools, int tool_count, int first, int last,
               ToolGradient* tool_gradients) const {
    cpdeform::Stopwatch watch(cpdeform::Phase::grid);
    const Box& box = momentum.box;
    const int width = box.size(2);
    for (int i = first; i < last; ++i)
      for (int j = box.low[1]; j <= box.high[1]; ++j) {
        const int64_t row = ((i - box.low[0]) * int64_t(box.size(1)) + (j - box.low[1])) * width;
        const Real* from = momentum.nodes + 4 * row;
        Real* to = gradient.nodes + 4 * row;
        bool special = boundary.touches(i, j, box.low[2], box.high[2]);
        for (int m = 0; m < tool_count; ++m) special |= tools[m].near_row(i, j);
        watch.change(special ? cpdeform::Phase::tools : cpdeform::Phase::grid);
        for (int k = 0; k < width; ++k) {
          const Real mass = from[4 * k + 3];
          Real* node = to + 4 * k;
          if (!(mass > smallest_mass)) {
            node[0] = node[1] = node[2] = node[3] = 0;
            continue;
          }
          const Real inverse = 1 / mass;
          const P raw = {inverse * from[4 * k], inverse * from[4 * k + 1], inverse * from[4 * k + 2]};
          P g = {node[0], node[1], node[2]};
          if (special) g = node_adjoint(tools, tool_count, i, j, k + box.low[2], raw + impulse, g, tool_gradients);
          node[0] = inverse * g.x;
          node[1] = inverse * g.y;
          node[2] = inverse * g.z;
          node[3] = -inverse * dot(g, raw);
        }
      }
  }

 private:
  // The velocity before each tool is computed again: contact nodes are few.
  P node_adjoint(const Motion* tools, int count, int i, int j, int k, const P& start, P g, ToolGradient* gradients) const {
    g = boundary.adjoint(i, j, k, through_tools(tools, count, i, j, k, start), g);
    for (int m = count - 1; m >= 0; --m)
      if (tools[m].near(i, j, k))
        g = Contact<Real>::adjoint(tools[m], softness, time_step, position(i, j, k), through_tools(tools, m, i, j, k, start), g,
                                   gradients[m]);
    return g;
  }
};

}  // namespace CPDEFORM_ISA
