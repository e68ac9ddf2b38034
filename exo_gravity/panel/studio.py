"""Recordings, trials and saved parameters, each in a new folder below `output`.

A recording is made by the package's `recorder`, a process. A trial records, lets a simulated device's virtual wearer or
a person perform the script, and reports the recording. It starts with every arm active and ends early when one is not.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.drive import State
from exo_gravity.core.trial.script import TrialScript

LEAD = 5.0  # s for a person to get ready
GRACE = 0.5  # s recorded after the last step
STOP_TIMEOUT = 10.0  # s for a recorder to end
FOLLOW_PERIOD = 0.1  # s
Parameters = Mapping[str, Mapping[str, Any]]


class Device(Protocol):
    """What a trial needs of the arms."""

    def parameters(self) -> Parameters:
        """Return the parameters of every node by full name."""

    def states(self) -> Mapping[str, str | None]:
        """Return the state of each arm; None if its bridge is silent."""

    async def perform(self, script: str) -> str:
        """Let the virtual wearer perform the script at this path; return '' or why not. '' without a simulator."""


class Studio:
    """`Files` of `exo_gravity.panel.desk`. note: called with a sentence for the log and the recording."""

    def __init__(self, output: str, scripts: Path | None, device: Device, note: Callable[[str], None]) -> None:
        self._output = Path(output).expanduser().resolve()
        self._scripts = {path.stem: path for path in sorted(scripts.glob("*.yaml"))} if scripts else {}
        self._device = device
        self._note = note
        self._recorder: subprocess.Popen[bytes] | None = None
        self._folder: Path | None = None
        self._began = 0.0
        self._trial: asyncio.Task[None] | None = None
        self._progress: dict[str, Any] = {"phase": "none"}
        self._reports: dict[str, Path] = {}
        self._saved = ""

    @property
    def trials(self) -> Collection[str]:
        """The trials to choose from."""
        return tuple(self._scripts)

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        is_on = self._recorder is not None and self._recorder.poll() is None
        recording = {
            "on": is_on,
            "foreign": not is_on and "/recorder" in self._device.parameters(),
            "folder": str(self._folder) if is_on else "",
            "seconds": round(time.monotonic() - self._began) if is_on else 0,
        }
        return {"recording": recording, "trial": self._progress, "saved": self._saved}

    def report(self, name: str) -> Path | None:
        """Return the report of a trial of this session."""
        path = self._reports.get(name)
        return path if path and path.is_file() else None

    def close(self) -> None:
        """End the recording."""
        if self._recorder is not None:
            self._recorder.terminate()

    async def record(self) -> str:
        """Start a recording."""
        return await self._start_recorder("recording")

    async def stop_recording(self) -> str:
        """End the recording; it stays if a trial needs it."""
        if self._trial is not None and not self._trial.done():
            return "a trial is running: stop the trial"
        return await self._stop_recorder()

    async def save(self) -> str:
        """Write the parameters in force as YAML, from which `launcher` starts."""
        content = {
            node: {"ros__parameters": nested(values)}
            for node, values in self._device.parameters().items()
            if values and not node.endswith(("/recorder", "/panel"))
        }
        if not content:
            return "no node has been found yet"
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        try:
            folder = self._new_folder("parameters")
            (folder / "params.yaml").write_text(text, encoding="utf-8")
        except OSError as error:
            return f"{self._output}: {error.strerror}"
        self._saved = str(folder / "params.yaml")
        return ""

    async def trial(self, name: str) -> str:
        """Start a trial."""
        if self._trial is not None and not self._trial.done():
            return "a trial is running already"
        states = self._device.states()
        if not states or set(states.values()) != {State.ACTIVE.value}:
            return "a trial starts when every arm is active"
        path = self._scripts[name]
        try:
            script = TrialScript.parse(yaml.safe_load(path.read_text(encoding="utf-8")))
        except (OSError, yaml.YAMLError, ParameterError) as error:
            return f"{path}: {error}"
        if problem := await self._start_recorder(name):
            return problem
        self._trial = asyncio.create_task(self._run(script, path))
        return ""

    async def stop_trial(self) -> str:
        """End the trial early; what was recorded is reported."""
        if self._trial is None or self._trial.done():
            return "no trial is running"
        self._progress = {**self._progress, "stop": True}
        return ""

    async def _run(self, script: TrialScript, path: Path) -> None:
        """Follow one trial from the recording to the report."""
        steps = [{"action": s.action, "value": list(s.value), "duration": s.duration} for s in script.steps]
        guided = not any(node.endswith("/simulator") for node in self._device.parameters())
        self._progress = {"phase": "running", "name": script.name, "guided": guided, "steps": steps, "step": -1}
        problem = "" if guided else await self._device.perform(str(path))
        problem = problem or await self._follow(script, time.monotonic() + (LEAD if guided else 0.0))
        folder, name = self._folder, script.name
        self._progress = {"phase": "reporting", "name": name}
        problem = problem or await self._stop_recorder()
        await self._stop_recorder()
        key = folder.name if folder else ""
        problem = problem or (await self._report(folder) if folder else "")
        has_report = folder is not None and (folder / "report.html").is_file()
        if folder and has_report:
            self._reports[key] = folder / "report.html"
        self._progress = {"phase": "done", "name": name, "problem": problem, "report": key if has_report else ""}
        self._note(f"trial {name} has ended: {problem or 'done'}")

    async def _follow(self, script: TrialScript, start: float) -> str:
        """Wait until the script is done; return '' or why it ended earlier."""
        while (elapsed := time.monotonic() - start) < script.duration + GRACE:
            index, since = script.at(elapsed) if elapsed >= 0.0 else (-1, elapsed)
            left = script.steps[index].duration - since if 0 <= index < len(script.steps) else -min(elapsed, 0.0)
            self._progress = {**self._progress, "step": index, "left": round(left, 1)}
            if self._progress.get("stop"):
                return "stopped by the operator"
            if set(self._device.states().values()) != {State.ACTIVE.value}:
                return "an arm is not active any more"
            if self._recorder is None or self._recorder.poll() is not None:
                return "the recorder has ended"
            await asyncio.sleep(FOLLOW_PERIOD)
        return ""

    async def _report(self, folder: Path) -> str:
        command = _python("exo_gravity.tools.report", str(folder / "bag"), "--output", str(folder))
        process = await asyncio.create_subprocess_exec(
            *command, stdout=asyncio.subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE
        )
        _, errors = await process.communicate()
        lines = errors.decode(errors="replace").strip().splitlines()
        return "" if process.returncode in (0, 1) and not lines else (lines[-1] if lines else "the report failed")

    def _new_folder(self, name: str) -> Path:
        """Create and return a folder with a new name. Raises OSError."""
        stem = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
        for number in itertools.count(1):
            folder = self._output / (stem if number == 1 else f"{stem}_{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir(parents=True)
                break
        return folder

    async def _start_recorder(self, name: str) -> str:
        if self._recorder is not None and self._recorder.poll() is None:
            return "a recording is running already"
        if "/recorder" in self._device.parameters():
            return "another recorder is running already"
        try:
            folder = self._new_folder(name)
            log = (folder / "recorder.log").open("wb")
        except OSError as error:
            return f"{self._output}: {error.strerror}"
        remaps = ("-r", "__node:=recorder", "-r", "__ns:=/", "--enclave", "/recorder")
        command = _python("exo_gravity.nodes.recorder.node", "--ros-args", *remaps, "-p", f"output:={folder / 'bag'}")
        # It watches its standard input, and ends the recording well if the panel dies.
        environment = {**os.environ, "EXO_GRAVITY_SUPERVISED": "1"}
        with log:
            self._recorder = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        self._folder, self._began = folder, time.monotonic()
        return ""

    async def _stop_recorder(self) -> str:
        process = self._recorder
        if process is None:
            return "nothing is being recorded"
        self._recorder = None
        process.terminate()
        try:
            code = await asyncio.to_thread(process.wait, STOP_TIMEOUT)
        except subprocess.TimeoutExpired:
            process.kill()
            return "the recorder did not end and was killed"
        return "" if code == 0 else f"the recorder ended with exit code {code}: see {self._folder}/recorder.log"


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return dotted names as the nested mappings of a parameter file, without empty lists, which ROS cannot read."""
    content: dict[str, Any] = {}
    for name, value in sorted(values.items()):
        if value == [] or name in ("use_sim_time", "start_type_description_service"):
            continue
        *branches, leaf = name.split(".")
        place = content
        for branch in branches:
            place = place.setdefault(branch, {})
        place[leaf] = value
    return content


def _python(module: str, *args: str) -> list[str]:
    return [sys.executable, "-c", f"from {module} import main; raise SystemExit(main())", *args]
