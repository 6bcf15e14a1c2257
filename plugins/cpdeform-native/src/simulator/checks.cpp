#include "checks.h"

#include <cmath>
#include <stdexcept>
#include <string>

#include "arrays.h"

namespace cpdeform {

namespace {

// Kernels number nodes by 32 bits, four numbers each.
constexpr int64_t least_grid = 8, most_grid = 512;
// Particles are numbered by 32 bits; poses and frames of all substeps of a step by 64.
constexpr int64_t most_particles = int64_t(1) << 28, most_substeps = int64_t(1) << 20;

[[noreturn]] void refuse(const std::string& name, double came, const char* expected) {
  throw std::invalid_argument(name + ": got " + std::to_string(came) + ", expected " + expected);
}

void expect_positive(const std::string& name, double value) {
  if (!(std::isfinite(value) && value > 0)) refuse(name, value, "a positive number");
}

void expect_not_negative(const std::string& name, double value) {
  if (!(std::isfinite(value) && value >= 0)) refuse(name, value, "zero or a positive number");
}

constexpr int64_t triangle_size = 30;

// A place of `size` numbers among `count`, which is a whole number.
int64_t expect_place(double came, int64_t size, int64_t count) {
  if (!(came >= 0 && came <= double(count - size) && came == std::floor(came))) refuse("grid", came, "a place within the numbers");
  return int64_t(came);
}

// How many of a tool's lengths must be positive.
size_t lengths_of(int kind) {
  switch (kind) {
    case sphere:
      return 1;
    case capsule:
    case rolling_pin:
    case chopsticks:
    case cylinder:
    case torus:
      return 2;
    case box:
      return 3;
    case mesh:
      return 4;
  }
  throw_unknown_tool(kind);
}

bool takes(int kind, int action_size) {
  if (action_size == 0) return true;
  if (kind == rolling_pin) return action_size == 3;
  if (kind == chopsticks) return action_size == 7;
  return action_size == 3 || action_size == 6;
}

}  // namespace

void throw_unknown_tool(int kind) {
  throw std::invalid_argument("kind: got " + std::to_string(kind) + ", expected a tool's number, 0 to " +
                              std::to_string(tool_kind_count - 1));
}

void check_numbers(const char* name, const std::vector<double>& numbers, size_t least, size_t most) {
  if (numbers.size() < least || numbers.size() > most)
    throw std::invalid_argument(std::string(name) + ": got " + std::to_string(numbers.size()) + " numbers, expected " +
                                std::to_string(least) + (most > least ? " to " + std::to_string(most) : std::string()));
  for (const double number : numbers)
    if (!std::isfinite(number)) refuse(name, number, "finite numbers");
}

void check_mesh(const double* numbers, int64_t count, int64_t nodes) {
  if (count <= 2 * nodes) refuse("grid", double(count), "more than two numbers a node");
  for (int64_t i = 0; i < count; ++i)
    if (!std::isfinite(numbers[i])) refuse("grid", numbers[i], "finite numbers");
  const double* lists = numbers + 2 * nodes;
  count -= 2 * nodes;
  for (int64_t node = 0; node < nodes; ++node) {
    const double place = numbers[nodes + node];
    if (place == 0) continue;
    const double* list = lists + expect_place(place, 2, count);
    const int64_t triangles = expect_place(list[0], 1, count - (list - lists));
    if (triangles < 1) refuse("grid", list[0], "at least one triangle in a list");
    for (int64_t i = 1; i <= triangles; ++i) expect_place(list[i], triangle_size, count);
  }
}

void check_scene(const Scene& scene) {
  expect_positive("time_step", scene.time_step);
  expect_positive("node_distance", scene.node_distance);
  expect_positive("particle_mass", scene.particle_mass);
  expect_not_negative("softness", scene.softness);
  expect_not_negative("ground_friction", scene.ground_friction);
  expect_between("grid_size", scene.grid_size, least_grid, most_grid);
  expect_between("ground_nodes", scene.ground_nodes, 0, most_grid + least_grid);
  expect_between("wall_nodes", scene.wall_nodes, 0, scene.grid_size);
  expect_between("substeps", scene.substeps, 1, most_substeps);
  expect_between("particle_count", scene.particle_count, 1, most_particles);
}

void check_tool(int kind, const std::vector<double>& size, double friction, int action_size, const std::vector<double>& scale,
                const std::vector<double>& lower, const std::vector<double>& upper) {
  const size_t lengths = lengths_of(kind);
  check_numbers("size", size, lengths, 4);
  for (size_t i = 0; i < size.size(); ++i) {
    if (i < lengths)
      expect_positive("size", size[i]);
    else
      expect_not_negative("size", size[i]);
  }
  expect_not_negative("friction", friction);
  if (!takes(kind, action_size))
    throw std::invalid_argument("action_size: got " + std::to_string(action_size) + ", expected a number of actions of this kind");
  check_numbers("scale", scale, size_t(action_size), 7);
  check_numbers("lower", lower, 3, 3);
  check_numbers("upper", upper, 3, 3);
}

}  // namespace cpdeform
