# make demo         four nodes as processes on the simulated device, about 90 s; a table and figures in trials/
# make calibrate-demo  a simulated arm with a wrong parameter file, calibrated, 5 minutes; a picture before and after
# make calibrate-study  20 random simulated devices, calibrated from motors to an arm that holds, offline, 20 minutes
# make test         the tests, 5 minutes on two cores
# make test-all     the same, then the longer ones (make test-long): studies, browser, 13 poses, video, SROS2
# make coverage     which share of the package the tests of `make test` execute, without those of running arms
# make lint         ruff, mypy, ament's flake8 and pep257, shellcheck
# make docs         these documents as a site, in build/site; a warning is an error
# make faults       the whole fault matrix on the simulated device, 40 minutes; a table and build/faults.json
# make mutations    deliberate defects, each of which must turn a row of the fault matrix unsafe; 20 minutes
# make soak         both arms for an hour: live changes, an active wearer, harmless faults; MINUTES=N for less
# make bench        the laws, the loop and the tools against peers, 15 minutes on a quiet machine; QUICK=1: part of it
# make ordinary     ordinary motors, sensors and computers for an hour of virtual time: no alarm; a table, 10 minutes
# make motion-monitor  which wrong efforts can_bridge sees, and an hour of a fast wearer, whom it must not disturb; 20 minutes
# make effort-study  how hard the simulated arm is to move, under every setting, 5 minutes; QUICK=1: part of it
# make wearer-study  the wearer's torque and share as estimated, on 20 calibrated devices, judged by the truth; an hour
# make baselines    in place of a model: PID, cube map, learned laws, a growing ANFIS, 6 minutes; build/baselines
# make imu-report   the trunk's inclination error on recorded motion, here and by VQF and imufusion; TRIALS=FOLDER
# make socketcan    motor bus and nodes on vcan0 and vcan1; RUN=COMMAND runs the tests through COMMAND, in a virtual machine for example
# make ros2-launch  the launch file under `ros2 launch`, where ROS 2 and a build of this package are sourced
# make two-computers  the arm on two computers over better and worse wires, 6 minutes; a table and build/two_computers.json
# make dist         wheel and source distribution in dist/, the wheel installed in an empty environment and tried
# make release      what a release needs, from its version to the fault matrix; one line says what is missing; QUICK=1
# make doctor       whether this computer is fit to carry an arm, half a minute; PARAMS=FILE, the simulated arm by default
# make panel        the simulated right arm and the operator's page, until Ctrl-C
# make presses      from a press on the operator's page to the torque on the bus; PRESSES=50
# make pythons      for each supported Python found here: set-up from nothing, a short trial, the nodes
# make constraints  renews the versions in constraints/
# make environment  .venv with all that tests and lint need
# make clean        removes what these made
#
# Each first installs what it needs in .venv; PYTHON=... selects the interpreter. Where ROS 2 is sourced its rclpy is
# used; elsewhere Jazzy's wheels from PyPI.

VENV := .venv
BIN := $(VENV)/bin
DEMO := imu sim report
TEST := $(DEMO) analysis panel validate video test
SETUP := VENV=$(VENV) .ci/setup

# Where it is set, as in many containers, each process would compile every library that it imports anew: a node takes
# three times as long to start.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo calibrate-demo calibrate-study test lint docs faults mutations bench motion-monitor ordinary effort-study wearer-study baselines imu-report \
        socketcan pythons constraints clean ros2-launch two-computers dist doctor panel presses release test-all test-long soak coverage environment

demo:
	@$(SETUP) $(DEMO)
	$(BIN)/trial demo

calibrate-demo:
	@$(SETUP) $(DEMO) calibrate
	$(BIN)/python -m bench.calibration.demo

calibrate-study:
	@$(SETUP) $(TEST) calibrate
	$(BIN)/python -m bench.calibration

# The files with longer tests: to read all others first would take half a minute.
LONG = $(shell grep -rlE 'mark\.thorough|IN_BROWSER' --include='test_*.py' test)

# Tests of running nodes need a machine that keeps up with them: they run alone. The other ones share a module's nodes
# and simulations: each file runs in one process.
test:
	@$(SETUP) $(TEST)
	$(BIN)/python -m pytest test -n auto --dist loadfile -m "not (real_time or browser or thorough)"
	$(BIN)/python -m pytest test/hardware test/nodes -m "real_time and not thorough"

test-all: test test-long

test-long:
	@$(SETUP) $(TEST)
	@mkdir -p build
	@command -v chromium chromium-browser >/dev/null || ! test -w /var/lib/dpkg || \
		(apt-get update && apt-get install --yes chromium) >build/chromium.log 2>&1 || true
	$(BIN)/python -m pytest bench $(LONG) -n auto --dist loadfile -m "(browser or thorough) and not real_time"
	$(BIN)/python -m pytest $(LONG) -m "(browser or thorough) and real_time"

environment:
	@$(SETUP) $(TEST) dev

coverage:
	@$(SETUP) $(TEST) dev
	COVERAGE_CORE=sysmon $(BIN)/python -m pytest test -n auto --dist loadfile -m "not (real_time or browser or thorough)" \
		--cov --cov-report term:skip-covered

lint:
	@$(SETUP) $(TEST) dev
	@VENV=$(VENV) .ci/lint

docs:
	@$(SETUP) bag docs
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --fresh-env --quiet --conf-dir docs . build/site
	@echo build/site/index.html

faults:
	@$(SETUP) $(TEST)
	$(BIN)/python -m test.faults.run

mutations:
	@$(SETUP) $(TEST)
	$(BIN)/python -m test.faults.mutations

soak:
	@$(SETUP) $(TEST)
	$(BIN)/python -m test.faults.soak --minutes $(or $(MINUTES),60)

bench:
	@$(SETUP) $(TEST)
	$(BIN)/python -m bench $(if $(QUICK),--quick)

ordinary:
	@$(SETUP) $(TEST)
	$(BIN)/python -m bench.ordinary

motion-monitor:
	@$(SETUP) $(TEST)
	$(BIN)/python -m bench.motion_monitor --hours $(or $(HOURS),1)

effort-study:
	@$(SETUP) $(TEST)
	$(BIN)/python -m bench.effort $(if $(QUICK),--quick)

wearer-study:
	@$(SETUP) $(TEST) calibrate
	$(BIN)/python -m bench.wearer
	$(BIN)/python -m bench.wearer.straps

baselines:
	@$(SETUP) $(TEST)
	$(BIN)/python -m bench.baselines

imu-report:
	@$(SETUP) imu validate
	$(BIN)/python -m bench.imu_report $(TRIALS)

socketcan:
	@$(SETUP) $(TEST)
	EXO_TEST_CAN_INTERFACE=socketcan EXO_TEST_CAN_CHANNEL=vcan0 PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 \
		$(RUN) $(BIN)/python -m pytest --noconftest -p no:cacheprovider \
		test/hardware/test_motor_bus.py test/hardware/test_mixed_bus.py \
		test/nodes/socketcan_link.py test/nodes/socketcan_nodes.py

ros2-launch:
	@$(SETUP) $(TEST)
	$(BIN)/python -m pytest test/nodes/ros2_launch.py

two-computers:
	@$(SETUP) $(TEST)
	@mkdir -p build
	$(BIN)/python -m test.two_computers --output build/two_computers.json

dist:
	@$(SETUP) dev
	VENV=$(VENV) .ci/dist

release:
	.ci/release

doctor:
	@$(SETUP) report
	$(BIN)/doctor $(if $(PARAMS),--params $(PARAMS))

panel:
	@$(SETUP) $(DEMO) panel
	$(BIN)/launcher --panel

presses:
	@$(SETUP) $(TEST)
	$(BIN)/python -m bench.panel press $(or $(PRESSES),50)

pythons:
	.ci/pythons

constraints:
	.ci/constraints

clean:
	rm -rf $(VENV) build dist install log trials exo_gravity.egg-info .mypy_cache .ruff_cache
