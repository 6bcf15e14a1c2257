// Motion of the tools under actions, in double, and its adjoint.
#pragma once

#include <cmath>

#include "contact.h"
#include "scene.h"

namespace CPDEFORM_ISA {

struct Motion {
  using P = Vector<double>;
  using Tool = cpdeform::Tool;
  struct Quaternion {
    double w = 1;
    P v;
  };

  // PlasticineLab's constants: how far a rolling pin rolls a radian, and the least gap between chopsticks
  static constexpr double rolling_radius = 0.03, smallest_gap = 0.06, small_angle_squared = 1e-6;

  static P cross(const P& a, const P& b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

  static Quaternion multiply(const Quaternion& a, const Quaternion& b) {
    return {a.w * b.w - dot(a.v, b.v), b.v * a.w + a.v * b.w + cross(a.v, b.v)};
  }
  static Quaternion conjugate(const Quaternion& a) { return {a.w, -a.v}; }

  // sin(angle/2) / angle and its derivative with respect to the squared angle, finite at zero
  static double half_sine_ratio(double squared) {
    if (!(squared > small_angle_squared)) return 0.5 - squared / 48.0;
    const double angle = std::sqrt(squared);
    return std::sin(0.5 * angle) / angle;
  }
  static double half_sine_ratio_slope(double squared) {
    if (!(squared > small_angle_squared)) return -1.0 / 48.0 + squared / 1920.0;
    const double angle = std::sqrt(squared);
    return (0.25 * std::cos(0.5 * angle) / angle - 0.5 * std::sin(0.5 * angle) / squared) / angle;
  }

  // Unit quaternion of a rotation vector.
  static Quaternion turn(const P& w) {
    const double squared = dot(w, w);
    return {std::cos(0.5 * std::sqrt(squared)), w * half_sine_ratio(squared)};
  }
  static P turn_adjoint(const P& w, const Quaternion& g) {
    const double squared = dot(w, w), ratio = half_sine_ratio(squared);
    // d cos(angle/2) / d w = -1/2 sin(angle/2)/angle w
    return g.v * ratio + w * (2 * half_sine_ratio_slope(squared) * dot(g.v, w) - 0.5 * ratio * g.w);
  }

  // Vertical cross the rod's downward axis: where a rolling pin goes, times `rolling_radius` a radian.
  static P rolling_direction(const Quaternion& q) {
    double r[3][3];
    const double numbers[4] = {q.w, q.v.x, q.v.y, q.v.z};
    rotation_of(numbers, r);
    return {-rolling_radius * r[2][1], 0, rolling_radius * r[0][1]};
  }

  static P displacement(const Tool& tool, const double* w, const Quaternion& q) {
    if (tool.kind != cpdeform::rolling_pin) return {w[0], w[1], w[2]};
    P result = rolling_direction(q) * w[0];
    result.y = w[2];
    return result;
  }

  // Rotation vectors of a substep in the world's frame and in the tool's own.
  static void turns(const Tool& tool, const double* w, P& outer, P& inner) {
    outer = inner = P{};
    if (tool.kind == cpdeform::rolling_pin) {
      outer = {0, -w[1], 0};
      inner = {0, w[0], 0};
    } else {
      (tool.kind == cpdeform::chopsticks ? inner : outer) = {w[3], w[4], w[5]};
    }
  }
  static bool rotates(const Tool& tool) { return tool.action_size > 3 || tool.kind == cpdeform::rolling_pin; }

  // Unlike min and max, lets nan through.
  static double clip(double x, double low, double high) { return x < low ? low : (x > high ? high : x); }

  // Pose after one substep with motion w.
  static void step(const Tool& tool, const double* w, const double* before, double* after) {
    const Quaternion q = {before[3], {before[4], before[5], before[6]}};
    const P p = P{before[0], before[1], before[2]} + displacement(tool, w, q);
    after[0] = clip(p.x, tool.lower[0], tool.upper[0]);
    after[1] = clip(p.y, tool.lower[1], tool.upper[1]);
    after[2] = clip(p.z, tool.lower[2], tool.upper[2]);
    Quaternion turned = q;
    if (rotates(tool)) {
      P outer, inner;
      turns(tool, w, outer, inner);
      turned = multiply(turn(outer), multiply(q, turn(inner)));
    }
    after[3] = turned.w;
    after[4] = turned.v.x;
    after[5] = turned.v.y;
    after[6] = turned.v.z;
    after[7] = before[7];
    if (tool.kind == cpdeform::chopsticks) {
      const double gap = before[7] - w[6];
      after[7] = gap < smallest_gap ? smallest_gap : gap;
    }
  }

  // Turns the gradient g of the pose after a substep into that of the pose before; gw is that of the motion.
  static void step_adjoint(const Tool& tool, const double* w, const double* before, double* g, double (&gw)[7]) {
    for (double& x : gw) x = 0;
    const Quaternion q = {before[3], {before[4], before[5], before[6]}};
    const P moved = P{before[0], before[1], before[2]} + displacement(tool, w, q);
    P gp = {g[0], g[1], g[2]};
    Quaternion gq = {g[3], {g[4], g[5], g[6]}};
    if (moved.x < tool.lower[0] || moved.x > tool.upper[0]) gp.x = 0;
    if (moved.y < tool.lower[1] || moved.y > tool.upper[1]) gp.y = 0;
    if (moved.z < tool.lower[2] || moved.z > tool.upper[2]) gp.z = 0;
    double gap = g[7];
    if (tool.kind == cpdeform::chopsticks) {
      if (before[7] - w[6] < smallest_gap) gap = 0;
      gw[6] = -gap;
    }
    if (rotates(tool)) {
      P outer, inner;
      turns(tool, w, outer, inner);
      const Quaternion own = turn(inner);
      const P go = turn_adjoint(outer, multiply(gq, conjugate(multiply(q, own))));
      const Quaternion rest = multiply(conjugate(turn(outer)), gq);
      const P gi = turn_adjoint(inner, multiply(conjugate(q), rest));
      gq = multiply(rest, conjugate(own));
      if (tool.kind == cpdeform::rolling_pin) {
        gw[0] = gi.y;
        gw[1] = -go.y;
      } else {
        const P& from = tool.kind == cpdeform::chopsticks ? gi : go;
        gw[3] = from.x;
        gw[4] = from.y;
        gw[5] = from.z;
      }
    }
    double numbers[4] = {gq.w, gq.v.x, gq.v.y, gq.v.z};
    if (tool.kind == cpdeform::rolling_pin) {
      gw[0] += dot(gp, rolling_direction(q));
      gw[2] = gp.y;
      double gr[3][3] = {};
      gr[2][1] = -rolling_radius * w[0] * gp.x;
      gr[0][1] = rolling_radius * w[0] * gp.z;
      const double own[4] = {q.w, q.v.x, q.v.y, q.v.z};
      rotation_adjoint(own, gr, numbers);
    } else {
      gw[0] = gp.x;
      gw[1] = gp.y;
      gw[2] = gp.z;
    }
    g[0] = gp.x;
    g[1] = gp.y;
    g[2] = gp.z;
    for (int i = 0; i < 4; ++i) g[3 + i] = numbers[i];
    g[7] = gap;
  }

  // A number as a state of another type holds it. Volatile, because GCC 12 drops the rounding where it vectorises for AVX-512.
  template <class Real>
  static double as_stored(double x) {
    volatile Real stored = Real(x);
    return double(stored);
  }

  // Fill frames 1.. of poses (steps * substeps + 1, tools, 8) from frame 0. Poses between steps are rounded to the state's type, so
  // that a run that goes on from a state is the run that was not interrupted.
  template <class Real>
  static void move(const cpdeform::Scene& scene, const Real* actions, int64_t steps, double* poses) {
    const int64_t width = int64_t(scene.tool_count) * cpdeform::pose_size;
    for (int64_t frame = 0; frame < steps * scene.substeps; ++frame) {
      const Real* action = actions + frame / scene.substeps * scene.action_size;
      for (int m = 0; m < scene.tool_count; ++m) {
        const Tool& tool = scene.tools[m];
        const double* before = poses + frame * width + m * cpdeform::pose_size;
        double* after = poses + (frame + 1) * width + m * cpdeform::pose_size;
        if (tool.action_size == 0) {
          for (int i = 0; i < cpdeform::pose_size; ++i) after[i] = before[i];
          continue;
        }
        double w[7] = {};
        for (int a = 0; a < tool.action_size; ++a) w[a] = tool.scale[a] * double(action[tool.action_offset + a]);
        step(tool, w, before, after);
        if ((frame + 1) % scene.substeps == 0)
          for (int i = 0; i < cpdeform::pose_size; ++i) after[i] = as_stored<Real>(after[i]);
      }
    }
  }

  // Pull gradients (steps * substeps + 1, tools, 8) of all frames back to the actions and, in place, to frame 0.
  template <class Real>
  static void move_adjoint(const cpdeform::Scene& scene, const Real* actions, int64_t steps, const double* poses,
                           double* grad_poses, double* grad_actions) {
    const int64_t width = int64_t(scene.tool_count) * cpdeform::pose_size;
    for (int64_t frame = steps * scene.substeps - 1; frame >= 0; --frame) {
      const int64_t row = frame / scene.substeps * scene.action_size;
      for (int m = 0; m < scene.tool_count; ++m) {
        const Tool& tool = scene.tools[m];
        double* g = grad_poses + (frame + 1) * width + m * cpdeform::pose_size;
        double* earlier = grad_poses + frame * width + m * cpdeform::pose_size;
        double current[cpdeform::pose_size];
        for (int i = 0; i < cpdeform::pose_size; ++i) current[i] = g[i];
        if (tool.action_size > 0) {
          double w[7] = {}, gw[7];
          for (int a = 0; a < tool.action_size; ++a) w[a] = tool.scale[a] * double(actions[row + tool.action_offset + a]);
          step_adjoint(tool, w, poses + frame * width + m * cpdeform::pose_size, current, gw);
          for (int a = 0; a < tool.action_size; ++a) grad_actions[row + tool.action_offset + a] += tool.scale[a] * gw[a];
        }
        for (int i = 0; i < cpdeform::pose_size; ++i) earlier[i] += current[i];
      }
    }
  }
};

}  // namespace CPDEFORM_ISA
