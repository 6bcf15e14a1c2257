// Python's signals in computations that go without the interpreter lock.
#pragma once

#include <nanobind/nanobind.h>

#include "threads.h"

namespace cpdeform {

// Run the handlers of signals that have come, as the interpreter does between two instructions. Whether one raised; its exception is
// then the current one of this thread. On other threads than the main one nothing happens.
inline bool signal_came() {
  nanobind::gil_scoped_acquire locked;
  return PyErr_CheckSignals() != 0;
}

// Do work without the interpreter lock; what a signal's handler raised meanwhile is raised here.
template <class Work>
void unlocked(Work&& work) {
  try {
    nanobind::gil_scoped_release released;
    work();
  } catch (const Interrupted&) {
    throw nanobind::python_error();
  }
}

}  // namespace cpdeform
