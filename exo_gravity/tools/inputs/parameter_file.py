"""The parameter file that drives everything: ROS 2's own YAML form, keyed by fully qualified node names.

    /imu: {ros__parameters: {...}}
    /right/can_bridge: {ros__parameters: {can: {interface: socketcan}, ...}}

The tools read it to find out which nodes to start and which arms they have; the nodes read it through ROS. `launcher`
stops them in order: bridges first, because they need the others while they let the arms down, and the recorder last.
"""

import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from fnmatch import fnmatchcase
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import Any

import yaml

from exo_gravity import packaged
from exo_gravity.core.errors import ParameterError, named
from exo_gravity.core.motors.joint_motor import OPTIONS, buses_of
from exo_gravity.core.safety.descent import DESCENT_TIMEOUT

FORM = "/namespace/executable: {ros__parameters: {...}}"
MAX_LIST = 100  # entries; the longest list of any parameter has 4, and ROS's reader takes minutes for 200,000
# libyaml is ten times faster; PyYAML is sometimes built without it.
Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

NODES_PACKAGE = "exo_gravity.nodes."
ONE_PROCESS = f"{NODES_PACKAGE}can_bridge.one_process"  # runs can_bridge and compensator
# What the executable does. The folder in which the user stands, '' in the path, is not searched for modules.
PROGRAM = """import sys
sys.path = [*filter(None, sys.path)]
sys.argv[0] = {name!r}
from {module} import main
sys.exit(main())
"""
WATCHDOG_TIMEOUT = 30.0  # s for the watchdog of a dead bridge to let the arm down
RECOVERY_TIMEOUT = WATCHDOG_TIMEOUT + DESCENT_TIMEOUT
STOP_TIMEOUT = 5.0  # s for any other node to end
SUPERVISED = {"EXO_GRAVITY_SUPERVISED": "1", "PYTHONUNBUFFERED": "1"}  # a node then ends with its standard input
# Starts can_bridge for one purpose: to let down an arm that was left behind, after that time for its watchdog.
RECOVERY = {"EXO_GRAVITY_RECOVER": f"{WATCHDOG_TIMEOUT:g}"}
ENDED_WELL = (0, 2)  # exit codes of a node that ended by itself: stopped, or with wrong parameters or no bus
# A node that may end alone: the arm does not depend on it, and a full disk must not let the arm down.
OBSERVERS = ("/recorder", "/robot_model", "/panel")
ABSOLUTE_TOPICS = ("/imu/data", "/imu/data_raw", "/imu/pitch_yaw")  # those that a namespace must be added to

Nodes = dict[str, dict[str, Any]]  # node name -> dotted parameter name -> value


def packaged_config(name: str) -> Path:
    """Return the path of a file of `config/`. Raises ParameterError if it is not installed."""
    if (path := packaged(name)) is None:
        raise ParameterError("config", name, "a file that the package installs: reinstall the package")
    return path


def load(path: str | Path) -> Nodes:
    """Return {node name: {dotted parameter name: value}} of a parameter file.

    Raises ParameterError, which names the file or the entry, if the file is missing, not YAML, or of another form.
    """
    try:
        content = yaml.load(Path(path).read_text(encoding="utf-8"), Loader)
    except OSError as error:
        raise ParameterError("params", str(path), f"a readable file ({error.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ParameterError("params", str(path), f"YAML ({' '.join(str(error).split())})") from None
    if not isinstance(content, dict) or not content:
        raise ParameterError("params", str(path), f"a mapping of {FORM}")
    return {str(node): _parameters(str(node), entry) for node, entry in content.items()}


def node_of(arm: str, executable: str) -> str:
    """Return the full name of a node of an arm: '/right/can_bridge'; an arm without a namespace is called 'arm'."""
    return f"/{executable}" if arm == "arm" else f"/{arm}/{executable}"


def _parameters(node: str, entry: Any) -> dict[str, Any]:
    if not node.startswith("/") or node.endswith("/"):
        raise ParameterError("node name", node, f"fully qualified, as in {FORM}")
    if not isinstance(entry, dict) or set(entry) != {"ros__parameters"}:
        raise ParameterError(node, entry, f"of the form {FORM}")
    return dict(_flat(node, "", entry["ros__parameters"] or {}))


def _flat(node: str, prefix: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Yield (dotted name, value) of each parameter; raise ParameterError for values that ROS cannot read."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _flat(node, f"{prefix}.{key}" if prefix else str(key), inner)
        return
    if value is None:
        raise ParameterError(f"{node} {prefix}", value, "given a value, or left out")
    if isinstance(value, list):
        if len(value) > MAX_LIST:
            raise ParameterError(f"{node} {prefix}", value, f"at most {MAX_LIST} entries; it has {len(value):,}")
        if len({type(item) for item in value}) > 1:
            # ROS's own reader refuses such a list without naming it.
            raise ParameterError(f"{node} {prefix}", value, "a list of one type: 1.0, not 1, next to 2.5")
    yield prefix, value


def _modules() -> dict[str, str]:
    """Return the executables that are nodes, each with its module, from the entry points of the installed package."""
    try:
        scripts = distribution("exo_gravity").entry_points.select(group="console_scripts")
    except PackageNotFoundError:
        return {}
    return {script.name: script.module for script in sorted(scripts) if script.module.startswith(NODES_PACKAGE)}


def node_names() -> tuple[str, ...]:
    """Return the executables that are nodes."""
    return tuple(_modules())


def command_of(node: str, module: str = "") -> list[str]:
    """Return the command that runs `node` ('/right/can_bridge') from this package. Raises ParameterError if none does.

    module: in place of the node's own. It looks for no file in a folder: python-can installs an executable `can_bridge`
    too.
    """
    name, modules = node.rpartition("/")[2], _modules()
    if name not in modules:
        raise ParameterError("node name", node, f"/namespace/executable, with one of {', '.join(modules)}")
    return [sys.executable, "-c", PROGRAM.format(name=name, module=module or modules[name])]


def stages(nodes: Iterable[str]) -> tuple[list[str], list[str], list[str]]:
    """Return the full names `nodes` in the order in which they stop: bridges, others, recorders."""
    found: tuple[list[str], list[str], list[str]] = [], [], []
    for node in nodes:
        found[0 if node.endswith("/can_bridge") else 2 if node.endswith("/recorder") else 1].append(node)
    return found


def guests_of(nodes: Iterable[str]) -> dict[str, str]:
    """Return the compensator of each can_bridge of `nodes` that has one."""
    pairs = {node: f"{node.rpartition('/')[0]}/compensator" for node in stages(nodes)[0]}
    return {bridge: compensator for bridge, compensator in pairs.items() if compensator in nodes}


def chosen(nodes: Iterable[str], only: Sequence[str]) -> list[str]:
    """Return the `nodes` that match one of the shell patterns `only`; without patterns, all.

    A pattern is compared with the full name: `/right/*`, `*/compensator`. Raises ParameterError if one matches no node.
    """
    names = list(nodes)
    for pattern in only:
        if not any(fnmatchcase(node, pattern) for node in names):
            raise ParameterError("only", pattern, f"a pattern that matches one of {', '.join(names)}")
    return [node for node in names if not only or any(fnmatchcase(node, pattern) for pattern in only)]


def check_buses(nodes: Nodes) -> None:
    """Raise ParameterError if two bridges would command motors on the same bus, which has one owner."""
    owner: dict[tuple[tuple[str, str], ...], str] = {}
    for node in stages(nodes)[0]:
        given = {k: v for k, v in nodes[node].items() if k.startswith("can.")}
        options = {k: v for k, v in given.items() if k.startswith(OPTIONS)}
        with named(f"{node} "):
            buses = buses_of(str(given.get("can.channel", node)), options)
        for name, (_, own) in buses.items():
            bus = tuple(sorted((k, str(v)) for k, v in {**given, "can.channel": name, **own}.items()))
            other = owner.setdefault(bus, node)
            if other != node:
                raise ParameterError(f"{node} can", dict(bus), f"different from the bus of {other}: one arm per bus")


def in_namespace(params: Path, namespace: str) -> Path:
    """Return a parameter file whose nodes are in `namespace` ('/lab'): `params` itself if that is ''."""
    if not namespace:
        return params
    content = yaml.load(params.read_text(encoding="utf-8"), Loader)
    path = Path(tempfile.mkdtemp(prefix="exo_gravity_"), params.name)
    path.write_text(yaml.safe_dump({f"{namespace}{node}": entry for node, entry in content.items()}), encoding="utf-8")
    return path
