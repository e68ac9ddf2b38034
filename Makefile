# make demo    the main job on the simulated device, about 75 s once everything is installed
# make test    all tests
# make bench   the laws, the loop and the tools against peers, 12 minutes, longer on a busy machine; QUICK=1: some of it
# make faults  the whole fault matrix on the simulated device, 11 minutes; a table and build/faults.json
# make socketcan  motor bus and nodes on vcan0; RUN=COMMAND puts a command before it, one that enters a virtual machine
# make clean   remove what these made
#
# Each sets up a virtual environment in .venv. Where ROS 2 is sourced its rclpy is used; elsewhere Jazzy's wheels are.

VENV := .venv
BIN := $(VENV)/bin
SETUP := setup.py Makefile

ifdef ROS_DISTRO
PYTHON ?= python3
VENV_OPTIONS := --system-site-packages
# ROS's messages are compiled against NumPy 1.
ROS := "numpy<2"
EXTRAS := imu,sim,report
else
# The first Python that runs: pyenv's shim alone may refuse.
PYTHON ?= $(shell for p in "$$(pyenv root 2>/dev/null)"/versions/3.12*/bin/python \
	python3.12 python3.13 python3.11 python3.10 python3; do \
	"$$p" -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null && echo "$$p" && break; done)
EXTRAS := ros,imu,sim,report
endif

.PHONY: demo test bench faults socketcan clean

demo: $(VENV)/demo
	$(BIN)/trial demo

test: $(VENV)/test
	$(BIN)/python -m pytest

bench: $(VENV)/test
	$(BIN)/python -m bench $(if $(QUICK),--quick)

faults: $(VENV)/test
	$(BIN)/python test/faults/run.py

socketcan: $(VENV)/test
	EXO_TEST_CAN_INTERFACE=socketcan EXO_TEST_CAN_CHANNEL=vcan0 PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 \
		$(RUN) $(BIN)/python -m pytest --noconftest -p no:cacheprovider \
		test/hardware/test_motor_bus.py test/nodes/socketcan_link.py test/nodes/socketcan_nodes.py

$(VENV)/demo: $(SETUP) | $(BIN)/python
	$(BIN)/python -m pip install --quiet $(ROS) --editable ".[$(EXTRAS)]"
	touch $@

$(VENV)/test: $(SETUP) | $(BIN)/python
	$(BIN)/python -m pip install --quiet $(ROS) --editable ".[$(EXTRAS),validate,test]"
	touch $@ $(VENV)/demo

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "exo_gravity needs Python 3.10 to 3.13; none was found" >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV_OPTIONS) $(VENV)

clean:
	rm -rf $(VENV) build install log trials exo_gravity.egg-info
