// Which instruction sets this build has, and which of them this processor can run.
#pragma once

#include <string>
#include <vector>

namespace cpdeform {

enum class InstructionSet { baseline, avx2, avx512 };

// The sets that were built and that this processor runs, slowest first.
std::vector<InstructionSet> available_instruction_sets();

const char* name_of(InstructionSet set);

// The set of that name; "" for the fastest. Throws std::invalid_argument where it is not available.
InstructionSet instruction_set_of(const std::string& name);

}  // namespace cpdeform
