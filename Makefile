# Each target first installs what it needs in .venv. PYTHON=... selects the interpreter. Where ROS 2 is sourced its rclpy
# is used; elsewhere Jazzy's wheels from PyPI. `make` alone prints the targets.

VENV := .venv
BIN := $(VENV)/bin
SETUP := VENV=$(VENV) .ci/setup

# Where it is set, as in many containers, each process would compile every library that it imports anew: a node takes
# three times as long to start.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help demo panel test lint bench study release

help:  # these lines
	@sed -nE 's/^([a-z-]+):[^#]*# (.*)/make \1\t\2/p' $(MAKEFILE_LIST) | expand -t 18

demo:  # all nodes as processes on the simulated device, 70 s; a table and figures in trials/
	@$(SETUP) @demo
	$(BIN)/trial demo

panel:  # the simulated right arm and the operator's page, until Ctrl-C
	@$(SETUP) @demo
	$(BIN)/launcher --panel

# Tests of running nodes need a machine that keeps up with them: they run alone. The other ones share a module's nodes
# and simulations: each file runs in one process.
test:  # the tests, 4 minutes on two idle cores; .ci/test-long plays the longer ones
	@$(SETUP) @test
	$(BIN)/python -m pytest --ignore test/bench -n auto --dist loadfile -m "not (real_time or browser or thorough)"
	$(BIN)/python -m pytest $$(grep -rl mark.real_time --include='test_*.py' test/hardware test/nodes) \
		-m "real_time and not thorough"

lint:  # ruff, mypy, ament's flake8 and pep257, shellcheck, and this repository's own rules and ceilings
	@$(SETUP) @test
	@VENV=$(VENV) .ci/lint

bench:  # the laws, the loop and the tools against peers, 20 minutes on a quiet machine; QUICK=1: part of it
	@$(SETUP) @test
	$(BIN)/python -m bench $(if $(QUICK),--quick)

study:  # the study NAME=...; without a name the list of them, with the fault matrix and the site of the documents
	@VENV=$(VENV) .ci/study $(NAME)

release:  # what a release needs, from its version to the fault matrix; one line says what is missing; QUICK=1
	@.ci/release
