"""Trial scripts by name or path, and the parameter file that a trial runs with."""

from __future__ import annotations

from pathlib import Path

import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.tools.inputs.parameter_file import load, packaged_config

RECORDER = "/recorder"


def packaged_trials() -> dict[str, Path]:
    """Return the scripts that come with the package, by name."""
    folder = packaged_config("trials/demo.yaml").parent
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


def read_script(name: str) -> tuple[Path, TrialScript]:
    """Return path and content of a packaged script or of a YAML file. Raises ParameterError."""
    packaged = packaged_trials()
    if name not in packaged and not name.endswith((".yaml", ".yml")):
        raise ParameterError("trial", name, f"{', '.join(packaged)} or a YAML file with a script")
    path = packaged.get(name, Path(name))
    try:
        return path.resolve(), TrialScript.parse(yaml.safe_load(path.read_text(encoding="utf-8")))
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        reason = " ".join(str(error).split())
        raise ParameterError("trial", name, f"a readable YAML file ({reason})") from None


def is_guided(params: Path) -> bool:
    """Return whether a person performs the script, because the parameter file has no simulator."""
    return not any(node.endswith("/simulator") for node in load(params))


def prepare(params: Path, script: Path, folder: Path, recorded: bool) -> Path:
    """Write the parameter file of one trial into the new `folder`, and return its path.

    It is `params` with the script for each simulator and, if `recorded`, a recorder. Raises ParameterError.
    """
    load(params)  # checks the form of the file
    content = yaml.safe_load(params.read_text(encoding="utf-8"))
    for node, entry in content.items():
        if node.endswith("/simulator"):
            entry["ros__parameters"]["trial"] = str(script)
    if recorded:
        content[RECORDER] = {"ros__parameters": {"output": str(folder / "bag"), "live": True}}
    path = folder / "params.yaml"
    try:
        folder.mkdir(parents=True)
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ParameterError("output", str(folder.parent), f"a writable folder ({error.strerror})") from None
    return path
