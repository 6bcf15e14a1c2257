// What a scene is to the kernels: plain numbers, the same for all instruction sets. Lengths in domain edges, times in seconds.
#pragma once

#include <cstdint>

namespace cpdeform {

enum ToolKind : int { sphere, capsule, box, cylinder, torus, rolling_pin, chopsticks, mesh, tool_kind_count };

struct Tool {
  int kind;
  double size[4];  // Sphere: radius. Capsule, RollingPin, Chopsticks: radius, height. Box: half extents, rounding. Cylinder: radius,
                   // half height. Torus: major radius, tube radius. Mesh: distance between nodes, numbers of nodes.
  const double* grid;  // Mesh: coefficients of the quadratic B-spline of the distances, C order; a number for each node, 0 or where
                       // the list of the triangles nearest to it is; the lists and triangles (see checks.h); not owned
  int64_t grid_count;
  double friction;
  int action_offset;
  int action_size;
  double scale[7];  // motion per substep at action 1: length, radians
  double lower[3], upper[3];
};

// What a tool of no known kind is: an error, defined in checks.cpp.
[[noreturn]] void throw_unknown_tool(int kind);

constexpr int pose_size = 8;  // position, quaternion wxyz, gap
constexpr int max_tools = 16;

struct Scene {
  double time_step;
  double node_distance;
  double particle_mass;  // also the particle volume, density is 1
  double gravity[3];
  double softness;  // 1/length; 0 is a hard boundary
  double ground_friction;
  double lower[3], upper[3];  // positions are clipped to these corners
  int ground_nodes;           // nodes below this number are the floor's boundary layer
  int wall_nodes;
  int grid_size;
  int substeps;
  int tool_count;
  int action_size;
  int64_t particle_count;
  Tool tools[max_tools];
};

}  // namespace cpdeform
