# make demo    install into .venv, check OpenGL, generate the demo sequence into out/demo
#              EXTRAS=learn,view also installs these extras (docs/install.md lists them)
# make test    install into .venv, check OpenGL, run the tests
# make lint    ruff, formatting, types; what the tests last covered      make format  rewrite what the formatter would; make coverage
# make docs    install into .venv, build the documentation into out/site
# make slow    the tests that take long       make bench WHAT=events   a benchmark
# make fuzz    damaged files (minutes)        make matrix    the tests on other Pythons, and with the oldest and the newest libraries
# make clean   remove what was built (not .venv, not out/)
#
# PYTHON=python3.12 chooses the interpreter .venv is made with, JOBS=4 the number of test processes.

JOBS ?= auto
EXTRAS ?=
WHAT ?= generate
PIP = .venv/bin/python -m pip --disable-pip-version-check
# setuptools warns about every editable install beside a folder of the same name; that is the layout wanted here.
INSTALL = PYTHONWARNINGS=ignore $(PIP) install --quiet --no-build-isolation -c constraints.txt
COVERED = if [ -f .coverage ]; then .venv/bin/python -m coverage report --sort=cover --skip-covered | tail -n 40; \
	else echo "coverage: not measured here yet (make coverage)"; fi
INPUTS = setup.cfg setup.py pyproject.toml constraints.txt tools/setup.sh Makefile

.PHONY: demo test lint format coverage docs slow bench fuzz matrix doctor setup opengl clean
.DELETE_ON_ERROR:

demo: .venv/.installed-core $(if $(EXTRAS),.venv/.extras-$(EXTRAS)) opengl
	@rm -rf out/demo
	.venv/bin/blinkgl generate configs/demo.yaml --out out/demo
	@echo "beside it: events.h5, flow/, images/ in DSEC's layout. Next:  . .venv/bin/activate  and README.md"

test: .venv/.installed-dev .venv/.installed-docs .venv/.kernels opengl
	.venv/bin/python -m pytest -q -n $(JOBS) --maxprocesses 4 --dist worksteal

# Seconds, and no OpenGL: before the tests, in continuous integration and as .pre-commit-config.yaml has it.
lint: .venv/.installed-dev
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/pyrefly check --python-interpreter-path .venv/bin/python
	@$(COVERED)

format: .venv/.installed-dev
	.venv/bin/ruff check --fix
	.venv/bin/ruff format

# By itself, since counting lines costs a third of the tests' time; `make lint` repeats what it found. Kernels and shaders are compiled and not seen.
coverage: .venv/.installed-dev .venv/.installed-docs .venv/.kernels opengl
	.venv/bin/python -m pytest -q -n $(JOBS) --maxprocesses 4 --dist worksteal --cov --cov-report=
	@$(COVERED)

docs: .venv/.installed-docs
	.venv/bin/python -m blinkgl.tools.site --out out/site

slow: .venv/.installed-dev opengl
	.venv/bin/python -m pytest -q -m slow

bench: .venv/.installed-dev opengl
	.venv/bin/python -m blinkgl.tools.bench $(WHAT)

fuzz: .venv/.installed-dev
	.venv/bin/python -m blinkgl.tools.fuzz --mutants 1000
	.venv/bin/python -m blinkgl.tools.fuzz configurations --mutants 1000

# Environments of nox, in .nox/; without torch, so that the tests of eflow are skipped.
matrix: .venv/.installed-dev opengl
	.venv/bin/nox -f tools/noxfile.py

doctor: .venv/.installed-core
	.venv/bin/blinkgl doctor

setup: .venv/.installed-dev opengl

# Stamps: a step runs again only when what it depends on has changed.

.venv/.made: tools/setup.sh
	@tools/setup.sh venv
	@$(PIP) install --quiet -c constraints.txt --upgrade pip setuptools wheel
	@touch $@

.venv/.installed-core: .venv/.made $(INPUTS)
	@echo "installing BlinkGL into .venv (minutes the first time)"
	@$(INSTALL) -e .
	@touch $@

.venv/.extras-%: .venv/.installed-core
	@tools/setup.sh extras $*
	@echo "installing the extras $* into .venv"
	@$(INSTALL) -e '.[$*]'
	@touch $@

.venv/.installed-dev: .venv/.installed-core
	@echo "installing the test tools into .venv"
	@$(INSTALL) -e '.[dev]'
	@$(INSTALL) -e '.[learn]' || echo "torch could not be installed: the tests of eflow will be skipped"
	@$(INSTALL) -e '.[onnx]' || echo "ONNX could not be installed: the tests of eflow export --onnx will be skipped"
	@$(INSTALL) -e '.[cluster]' || echo "Ray could not be installed: the tests of the Ray executor will be skipped"
	@$(INSTALL) -e '.[physics]' || echo "MuJoCo could not be installed: the tests of falling bodies will be skipped"
	@$(INSTALL) -e '.[formats]' || echo "rosbags and dv-processing could not be installed: the tests of ROS bags will be skipped"
	@$(INSTALL) -e '.[view]' || echo "viser could not be installed: the tests of the viewer will be skipped"
	@touch $@

# The tests build the site, too: a dead link is an error.
.venv/.installed-docs: .venv/.installed-core
	@echo "installing what the documentation is built with into .venv"
	@$(INSTALL) -e '.[docs]' || echo "Zensical could not be installed: the documentation will not be built, nor its tests run"
	@touch $@

# Once per machine instead of in somebody's first run; where it fails, the first run compiles.
.venv/.kernels: .venv/.installed-core $(wildcard blinkgl/events/*.py) | opengl
	-@.venv/bin/python -m blinkgl.show.compile_kernels
	@touch $@

# No stamp: it takes half a second, and system packages come and go without make seeing it.
opengl: .venv/.installed-core
	@tools/setup.sh opengl

clean:
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache .hypothesis .coverage .venv/.kernels
	find blinkgl eflow shaders configs tools tests -name __pycache__ -type d -prune -exec rm -rf {} +
