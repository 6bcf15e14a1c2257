// What a scene must keep to before kernels may see it. Python's models say the same with better words; these are the last to ask.
// All throw std::invalid_argument.
#pragma once

#include <cstddef>
#include <vector>

#include "scene.h"

namespace cpdeform {

// A scene that has its constants; its tools are checked one by one.
void check_scene(const Scene& scene);

// A tool as it is about to be added.
void check_tool(int kind, const std::vector<double>& size, double friction, int action_size, const std::vector<double>& scale,
                const std::vector<double>& lower, const std::vector<double>& upper);

// The numbers of a mesh's distances on so many nodes: a coefficient of each; a number for each, 0 or where its list is; the lists, each
// the number of its triangles and where the numbers of each are; the triangles. Places are counted from behind the nodes' numbers.
void check_mesh(const double* numbers, int64_t count, int64_t nodes);

// That there are between `least` and `most` numbers, all finite.
void check_numbers(const char* name, const std::vector<double>& numbers, std::size_t least, std::size_t most);

}  // namespace cpdeform
