"""The subjects' folders below `output`, SUBJECT/DATE/TRIAL: who is recorded now, what was recorded, the wearers' files.

A wearer's file, SUBJECT/wearer.yaml, holds the parameters of `compensator` that belong to the subject. Folders of
recordings without a subject lie directly below `output`.
"""

import re
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.trial.session import Session, check_text
from exo_gravity.panel.view import OF_SUBJECT

WEARER = "wearer.yaml"
FOLDER = re.compile(r"(.+)_(\d{4})(\d\d)(\d\d)_(\d\d)(\d\d)(\d\d)(_\d+)?")  # of a recording or trial
MOST = 200  # recordings that the page lists


class Sessions:
    """The present session, and the past ones below `output`. device: as in `Recordings`."""

    def __init__(self, output: str, device: Any) -> None:
        self.output = Path(output).expanduser().resolve()
        self.present = {"subject": "", "protocol": "", "note": ""}  #: `Session` of what is recorded from now on
        self._device = device
        self._wearer: dict[str, Any] = {}  # parameters in the subject's file

    @property
    def folder(self) -> Path:
        """Where the present session is recorded today."""
        return self.output / Session(**self.present).folder(datetime.now())

    def shown(self) -> dict[str, Any]:
        """Return what the page shows of the present session."""
        return {**self.present, "folder": str(self.output / self.present["subject"]), "wearer": self._wearer}

    async def session(self, **present: str) -> str:
        """Make this subject, protocol and note the present session, and read the wearer's file."""
        try:
            path = self.output / Session(**present).subject / WEARER
            content = yaml.safe_load(path.read_text(encoding="utf-8")) if present["subject"] and path.is_file() else {}
            self._wearer = {name: OF_SUBJECT[name].check(value) for name, value in content.items()}
        except ParameterError as error:  # without the value, which the log must not have: it may be a name
            return f"{error.name} must be {error.expected}"
        except (OSError, yaml.YAMLError, AttributeError, KeyError) as error:
            return f"{path} must be a mapping of {', '.join(OF_SUBJECT)} ({' '.join(str(error).split())})"
        self.present = present
        return ""

    async def keep_wearer(self) -> str:
        """Write the wearer's data and workspace in force to the subject's file."""
        nodes = self._device.parameters().items()
        in_force: dict[str, Any] = next((values for node, values in nodes if node.endswith("/compensator")), {})
        if not self.present["subject"] or not in_force:
            return "no subject is chosen" if in_force else "no arm has been found yet"
        wearer = {name: in_force[name] for name in OF_SUBJECT if name in in_force}
        path = self.output / self.present["subject"] / WEARER
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(yaml.safe_dump(wearer, sort_keys=False, default_flow_style=None, width=120), "utf-8")
        except OSError as error:
            return f"{path}: {error.strerror}"
        self._wearer = wearer
        return ""

    async def marker(self, text: str) -> str:
        """Set a marker in the recording."""
        try:
            return str(self._device.mark(check_text("text", text) or "marker"))
        except ParameterError as error:
            return f"{error.name} must be {error.expected}"

    def past(self) -> dict[str, list[Any]]:
        """Return the codes of all subjects, and the recordings and trials, the newest first."""
        found = []
        for path in (*self.output.glob("*_*/"), *self.output.glob("*/*-*-*/*_*/")):
            if (match := FOLDER.fullmatch(path.name)) and ((path / "bag").is_dir() or (path / "report.html").is_file()):
                name, year, month, day, hour, minute, second, _ = match.groups()
                *subject, _ = path.relative_to(self.output).parts
                when = f"{year}-{month}-{day} {hour}:{minute}:{second}"
                key = path.relative_to(self.output).as_posix() if (path / "report.html").is_file() else ""
                found.append({"subject": "".join(subject[:1]), "trial": name, "when": when, "report": key})
        found.sort(key=lambda entry: entry["when"], reverse=True)
        kept = {path.parent.name for path in self.output.glob(f"*/{WEARER}")}
        return {"subjects": sorted(kept | {str(entry["subject"]) for entry in found} - {""}), "past": found[:MOST]}

    def report(self, name: str) -> Path | None:
        """Return the report in the folder `name` below `output`; None without one."""
        path = (self.output / name / "report.html").resolve()
        return path if path.is_relative_to(self.output) and path.is_file() else None
