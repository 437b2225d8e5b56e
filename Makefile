# make walk   installs into .venv, simulates the paper's walk and says where its report is
# make test   installs what that needs too, checks style and types and runs the tests
# make docs   builds the documentation into out/site
# make fbse   prints how good the friction estimate is, and writes out/fbse/report.html
# make rivals compares all methods of estimating friction, and writes out/rivals/*/report.html
# make hidden hides physics in the robot and prints how well it is found, and writes out/hidden/report.html
# make bench  prints speeds, as ratios measured in one run
# make fuzz   gives the commands 20,000 wrong files
# make minimum  tries the oldest versions of all dependencies
PYTHON ?= python3
OLDEST_PYTHON ?= python3.10
VENV := .venv
# What users need, and what developers need beside it.
INSTALLED := $(VENV)/.installed
DEVELOPED := $(VENV)/.developed
# Compiled kernels are kept by what their sources say: a cache beside them would not notice a change in a module that they call.
export NUMBA_CACHE_DIR := $(CURDIR)/$(VENV)/numba/$(shell find fbse_drake -name '*.py' | LC_ALL=C sort | xargs cat | cksum | cut -d' ' -f1)

# The tests start many processes, and each would compile the package's modules anew if it were
# forbidden to keep them.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: walk test minimum docs lint kernels kernels-biped kernels-others characters format bench fuzz fbse rivals hidden clean

# What the commands to come import is compiled meanwhile: an environment may forbid them to keep it.
walk: $(INSTALLED)
	$(VENV)/bin/python -m compileall -qq fbse_drake $(VENV)/lib & \
	$(VENV)/bin/fbse simulate paper_walk --meshcat --out out/paper_walk; status=$$?; wait; exit $$status

# A file's tests share its runs, so they stay on one worker. Each has a core: threads of the linear algebra would wait for each other.
test: $(DEVELOPED)
	$(MAKE) --jobs 2 lint kernels characters
	MPLBACKEND=Agg OMP_NUM_THREADS=1 $(VENV)/bin/pytest -n auto --dist loadfile --no-loadscope-reorder

# Files that call every dependency, in some minutes; most of it is compiled.
minimum:
	$(OLDEST_PYTHON) -m venv out/minimum
	out/minimum/bin/pip install --quiet --editable ".[dev]" --constraint constraints-minimum.txt
	NUMBA_CACHE_DIR=$(CURDIR)/out/minimum/numba MPLBACKEND=Agg out/minimum/bin/python -m pytest \
		$(addprefix tests/test_,log.py effects.py regression.py export.py lipm.py learned_friction.py \
		bag_map.py convert.py campaign.py report.py cli.py api.py)

lint: $(DEVELOPED)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy

# Compiles estimators that many tests need, once for all workers, which grow by it: those of two legs,
# and those of four, of an arm and of the filter joint by joint, side by side.
kernels: kernels-biped kernels-others

kernels-biped: WALKS = ('paper_walk_fbse', None), ('paper_walk_fbse', 'paper_method')
kernels-others: WALKS = ('quadruped_trot', None), ('bsc_arm', None), ('paper_walk_fbse', None, 'estimator.friction=!ModelAided {}')
kernels-biped kernels-others: $(DEVELOPED)
	$(VENV)/bin/python -c "from fbse_drake import load_scenario as load, simulate; \
		[simulate(load(file, name, ['duration=0.01', *changes])) for file, name, *changes in ($(WALKS))]"

# Hypothesis keeps a table of all characters, whose making takes 200 MiB: not in a worker of the
# tests.
characters: $(DEVELOPED)
	$(VENV)/bin/python -W ignore -c "from hypothesis.strategies import text; text().example()"

format: $(DEVELOPED)
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

# The documentation, strictly: a broken link is an error. Its tests run here too, for some need MkDocs.
docs: $(DEVELOPED)
	$(VENV)/bin/pip install --quiet --editable ".[dev,docs]" --constraint constraints.txt
	$(VENV)/bin/mkdocs build
	$(VENV)/bin/pytest tests/test_docs.py

bench: $(DEVELOPED)
	$(VENV)/bin/python -m benchmarks.closed_loop
	$(VENV)/bin/python -m benchmarks.effects
	$(VENV)/bin/python -m benchmarks.estimator_tick
	$(VENV)/bin/python -m benchmarks.convert
	$(VENV)/bin/python -m benchmarks.campaigns

# Nothing may end in a traceback, hang, leave a half-written file or run code; what does is kept in out/fuzz. About two hours on a core.
fuzz: $(DEVELOPED)
	$(VENV)/bin/python -m benchmarks.fuzz

# How good the friction estimate is, in tables: ten seeds of every walk, half an hour on two cores; then on walks that nobody tuned to,
# with faults of the sensors, beside the smallest error that the sensors allow, and whether it is as sure as it says, a quarter of an hour
# each at most. Walks that are done are not walked again while nothing in the package changes.
fbse: $(DEVELOPED)
	$(VENV)/bin/python -m benchmarks.fbse
	$(VENV)/bin/python -m benchmarks.off_nominal
	$(VENV)/bin/python -m benchmarks.completed_model
	$(VENV)/bin/python -m benchmarks.faults
	$(VENV)/bin/python -m benchmarks.limit --seeds 10
	$(VENV)/bin/python -m benchmarks.consistency --seeds 10

# All methods of estimating friction against each other, ten seeds of every case, some hours on two cores; goes on where it was stopped.
rivals: $(DEVELOPED)
	$(VENV)/bin/fbse rivals paper_walk --set duration=4.3 --seeds 10 --out out/rivals/paper_walk
	$(VENV)/bin/fbse rivals hrp2_walk_fbse --set duration=4.3 --seeds 10 --out out/rivals/hrp2_walk_fbse

# How well missing physics is found: some 430 logs, an hour and a half on two cores; goes on where it was stopped. By hand: --quick, --only NAME.
# Then in another simulator, if the extra `mujoco` is installed: some 70 logs, a quarter of an hour; and in recordings of machines that
# are drawn, ten minutes.
hidden: $(DEVELOPED)
	$(VENV)/bin/python -m benchmarks.hidden
	$(VENV)/bin/python -m benchmarks.mujoco_hidden
	$(VENV)/bin/python -m benchmarks.recordings

# Installs again when the package's needs change. Modules are compiled when they are first imported:
# most never are.
$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --upgrade pip
	$(VENV)/bin/pip install --quiet --no-compile --editable . --constraint constraints.txt
	touch $@

$(DEVELOPED): $(INSTALLED)
	$(VENV)/bin/pip install --quiet --no-compile --editable ".[dev]" --constraint constraints.txt
	touch $@

clean:
	rm -rf $(VENV) out
