#include "instruction_sets.h"

#include <stdexcept>

namespace cpdeform {

std::vector<InstructionSet> available_instruction_sets() {
  std::vector<InstructionSet> sets = {InstructionSet::baseline};
#if defined(CPDEFORM_HAS_AVX2)
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) sets.push_back(InstructionSet::avx2);
#endif
#if defined(CPDEFORM_HAS_AVX512)
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw") &&
      __builtin_cpu_supports("avx512vl"))
    sets.push_back(InstructionSet::avx512);
#endif
  return sets;
}

const char* name_of(InstructionSet set) {
  switch (set) {
    case InstructionSet::avx2:
      return "avx2";
    case InstructionSet::avx512:
      return "avx512";
    default:
      return "baseline";
  }
}

InstructionSet instruction_set_of(const std::string& name) {
  const std::vector<InstructionSet> sets = available_instruction_sets();
  if (name.empty()) return sets.back();
  std::string known;
  for (InstructionSet set : sets) {
    if (name == name_of(set)) return set;
    known += known.empty() ? name_of(set) : std::string(", ") + name_of(set);
  }
  throw std::invalid_argument("instruction set '" + name + "' is not available here; available: " + known);
}

}  // namespace cpdeform
