# `make reach` and `make test` need nothing but Python 3.11 and this file: they make .venv themselves.
# Kept to GNU make 3.81 (macOS) and POSIX sh.

VENV := .venv
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
STAMP4 := .venv-opencv4/.installed
STAMP_MUJOCO3 := .venv-mujoco3/.installed
DOCS_STAMP := $(VENV)/.docs
MAKE_VENV := .ci/make_venv

# A sourced ROS set-up puts its own packages and pytest plugins before ours. Without bytecode files, each of the
# hundreds of programs that the tests start would compile all sources again.
unexport PYTHONPATH PYTHONHOME PYTHONDONTWRITEBYTECODE
# The matrices are small, so the threads of OpenBLAS would only wait for each other.
export OPENBLAS_NUM_THREADS := 1

# An editable install contains the path of the checkout. A moved checkout or another PYTHON needs a new install.
ifneq ($(shell cat $(STAMP) 2>/dev/null),$(CURDIR))
STALE := FORCE
endif
ifneq ($(shell cat $(STAMP4) 2>/dev/null),$(CURDIR))
STALE4 := FORCE
endif
ifneq ($(shell cat $(STAMP_MUJOCO3) 2>/dev/null),$(CURDIR))
STALE_MUJOCO3 := FORCE
endif
ifneq ($(strip $(PYTHON)),)
export PYTHON
ifneq ($(shell '$(PYTHON)' -V 2>&1 || :),$(shell $(PY) -V 2>&1 || :))
STALE := FORCE
endif
endif

.PHONY: help reach test explore soak fuzz strangers lerobot check lint types imports format docs wheel test-opencv4 test-mujoco3 constraints clean FORCE

help:
	@echo 'make reach         a camera sees a marker and the arm reaches it (ARGS="--help" for its options)'
	@echo 'make test          the tests (ARGS="-k puma" chooses some)'
	@echo 'make explore       the same tests with new random examples of every law'
	@echo 'make check         style, mypy on the built wheel, import contracts'
	@echo 'make format        format the code and sort the imports with ruff'
	@echo 'make docs          the pages and the API as a site, in build/site'
	@echo 'make soak          the long tests'
	@echo 'make fuzz          random bytes against codec, parsers, servos and driver, guided by coverage'
	@echo 'make strangers     third-party servo clients, unmodified, on the virtual bus'
	@echo 'make lerobot       the programs of LeRobot, unmodified, on simulated arms (5 GB, Python 3.12)'
	@echo 'make test-opencv4  the camera tests with OpenCV 4, in a second environment'
	@echo 'make test-mujoco3  model, kernel, solver, hardware and figure tests with MuJoCo 3, in another environment'
	@echo 'make bench-camera  the accuracy and speed of the camera (ARGS="--quick --rows marker board")'
	@echo 'make wheel         build wheel and sdist into dist/ and try both in an empty environment'
	@echo 'make constraints   rewrite constraints.txt with the newest versions'
	@echo 'make clean         remove build files and environments'
	@echo
	@echo 'PYTHON=python3.12 chooses the interpreter of .venv.'

bench-camera: $(STAMP)
	@$(PY) -m benchmarks.camera $(ARGS)

reach: $(STAMP)
	@$(PY) -m robot_ik reach $(ARGS)

# Real-time tests of servos fail where three workers share two cores.
# All tests of a file run in one worker, so that files do not share compiled code and open devices.
WORKERS := 2
test: $(STAMP)
	@$(PY) -m pytest -n $(WORKERS) --dist loadfile $(ARGS)

explore: $(STAMP)
	@ROBOT_IK_EXAMPLES=explore $(PY) -m pytest -n $(WORKERS) --dist loadfile $(ARGS)

soak: $(STAMP)
	@$(PY) -m pytest -m soak --timeout 3600 $(ARGS)

# atheris is not a dependency, because it has wheels for Linux only. The fast targets come first.
fuzz: $(STAMP)
	@test -d $(VENV)/fuzz || $(PY) -m pip install --quiet --disable-pip-version-check --target $(VENV)/fuzz atheris
	@PYTHONPATH=$(VENV)/fuzz $(PY) tests/fuzz/fuzz_codec.py --law codec servo_parser host_parser fast_parser driver $(ARGS)
	@PYTHONPATH=$(VENV)/fuzz $(PY) tests/fuzz/fuzz_codec.py --law servos arm $(ARGS)

# Third-party clients, in their own environment, because they are not dependencies.
strangers: $(STAMP)
	@PYTHON=$(PY) tests/strangers/install .venv-strangers
	@$(PY) -m pytest tests/strangers/check_clients.py $(ARGS)

# The programs of LeRobot on simulated arms, in their own environment with PyTorch. It needs Python 3.12.
lerobot:
	@tests/lerobot/programs/install .venv-lerobot
	@cd tests/lerobot/programs && ../../../.venv-lerobot/bin/python -m pytest --noconftest -p no:robot_ik.pytest_plugin \
		-c /dev/null --rootdir . check_programs.py ../../test_gym.py $(ARGS)

check: lint types imports

lint: $(STAMP)
	@$(PY) .ci/check_style.py

types: $(STAMP)
	@.ci/check_types $(VENV)

imports: $(STAMP)
	@$(PY) .ci/link_typed.py $(VENV)/typed
	@cd $(VENV)/typed && ../bin/python -c 'from importlinter.cli import lint_imports_command as lint; lint()' --no-logo --config ../../pyproject.toml

format: $(STAMP)
	@$(PY) .ci/check_style.py --format

# -E reads every page again, -W makes a warning an error.
docs: $(DOCS_STAMP)
	@$(PY) -m sphinx -E -W --keep-going -q -d build/doctrees -c docs . build/site
	@echo 'build/site/index.html'

wheel: $(STAMP)
	@rm -rf build dist
	@$(PY) -m build --no-isolation . > $(VENV)/build.log 2>&1 || { cat $(VENV)/build.log; exit 1; }
	@$(PY) .ci/try_wheel.py dist

test-opencv4: $(STAMP4)
	@ROBOT_IK_REQUIRE="$${ROBOT_IK_REQUIRE:+$$ROBOT_IK_REQUIRE,}opencv4" .venv-opencv4/bin/python -m pytest tests/camera $(ARGS)

# The parts that call MuJoCo. Only `make test` runs the files that measure only the compiler or the clock.
MUJOCO3_TESTS := tests/models tests/kernels/test_kinematics.py tests/kernels/test_residuals.py tests/kernels/test_second_order.py \
	tests/solvers/test_laws.py tests/solvers/analytic tests/hardware/test_simulated.py tests/hardware/test_bus_contract.py \
	tests/hardware/test_arms_people_own.py tests/hardware/virtual/test_world.py tests/figure
test-mujoco3: $(STAMP_MUJOCO3)
	@.venv-mujoco3/bin/python -m pytest -n $(WORKERS) --dist loadfile $(MUJOCO3_TESTS) $(ARGS)

# --universal: one file for every system and Python; without index, folder or local versions of this machine.
constraints: $(STAMP)
	@$(PY) -m venv $(VENV)/uv
	@$(VENV)/uv/bin/python -m pip install --quiet --disable-pip-version-check uv
	@sed -n '/^#/p' constraints.txt > $(VENV)/constraints.new
	@$(VENV)/uv/bin/uv pip compile --quiet --upgrade --universal --python-version 3.11 --all-extras --strip-extras \
		--no-config --no-annotate --no-header --no-emit-index-url --no-emit-find-links \
		pyproject.toml > $(VENV)/constraints.txt
	@cat $(VENV)/constraints.txt >> $(VENV)/constraints.new && mv $(VENV)/constraints.new constraints.txt
	@git --no-pager diff --stat constraints.txt

clean:
	rm -rf $(VENV) .venv-opencv4 .venv-mujoco3 .venv-lerobot .venv-strangers build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache

$(STAMP): pyproject.toml constraints.txt $(MAKE_VENV) .ci/link_stubs.py $(STALE)
	@$(MAKE_VENV) $(VENV) constraints.txt '.[web,video,record,gamepad,plots,maps,cluster,descriptions,dev]'
	@$(PY) .ci/link_stubs.py $(VENV)/stubs
	@printf '%s\n' '$(CURDIR)' > $@

# Only `make docs` needs these packages.
$(DOCS_STAMP): $(STAMP)
	@$(PY) -m pip install --quiet --disable-pip-version-check --no-build-isolation --constraint constraints.txt --editable '.[docs]'
	@touch $@

# The same versions except OpenCV, without the extras that no camera test uses.
$(STAMP4): pyproject.toml constraints.txt $(MAKE_VENV) $(STALE4)
	@mkdir -p build
	@sed 's/^\(opencv-contrib-python-headless\)==.*/\1<5/' constraints.txt > build/constraints-opencv4.txt
	@$(MAKE_VENV) .venv-opencv4 build/constraints-opencv4.txt '.[video,dev]'
	@printf '%s\n' '$(CURDIR)' > $@

# The same versions except MuJoCo, which is one package before 4. Its version is the last of series 3.
$(STAMP_MUJOCO3): pyproject.toml constraints.txt $(MAKE_VENV) $(STALE_MUJOCO3)
	@mkdir -p build
	@sed -e 's/^mujoco==.*/mujoco==3.17.0/' -e '/^mujoco-core==/d' -e '/^mujoco-studio==/d' constraints.txt > build/constraints-mujoco3.txt
	@$(MAKE_VENV) .venv-mujoco3 build/constraints-mujoco3.txt '.[video,dev]'
	@printf '%s\n' '$(CURDIR)' > $@
