"""Recordings, trials and saved parameters, each in a new folder below `output`, of the present session.

A recording is made by the package's `recorder`, a trial by its command `trial --attach`: processes, which this module
starts, follows and ends. A simulated device's virtual wearer or a person performs the script of a trial. It starts with
every arm active and ends early when one is not.
"""

import asyncio
import contextlib
import itertools
import json
import os
import sys
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Callable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.safety.drive import State
from exo_gravity.core.trial.script import TrialScript
from exo_gravity.panel.sessions import Sessions

STOP_TIMEOUT = 10.0  # s for a recorder to end


class Recordings(Sessions):
    """`files` of `exo_gravity.panel.control.Control`.

    device: the arms. It has `parameters()` of every node by full name, `states()` of each arm (None if its bridge is
    silent), `mark(text)`, which publishes a marker, and a coroutine function `perform(path)` that lets the virtual
    wearers perform a script, '' for none; both return '' or why not. note: called with a sentence for the log. clock:
    monotonic s.
    """

    def __init__(
        self, output: str, scripts: Path | None, device: Any, note: Callable[[str], None], clock: Callable[[], float]
    ) -> None:
        #: the scripts to choose from, by name
        self.trials = {path.stem: path for path in sorted(scripts.glob("*.yaml"))} if scripts else {}
        super().__init__(output, device)
        self._note = note
        self._clock = clock
        self._recorder: asyncio.subprocess.Process | None = None
        self._folder: Path | None = None
        self._began = 0.0
        self._trial: asyncio.subprocess.Process | None = None
        self._following: asyncio.Task[None] | None = None
        self._progress: dict[str, Any] = {"phase": "none"}
        self._saved = ""

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        is_on = self._is_recording() or self._progress["phase"] == "running"
        recording = {
            "on": is_on,
            "foreign": not is_on and "/recorder" in self._device.parameters(),
            "folder": str(self._folder or "") if is_on else "",
            "seconds": round(self._clock() - self._began) if is_on else 0,
        }
        return {"recording": recording, "trial": self._progress, "saved": self._saved, "session": self.shown()}

    def close(self) -> None:
        """End the recording and the trial."""
        for process in (self._recorder, self._trial):
            if process is not None and process.returncode is None:
                process.terminate()

    async def record(self) -> str:
        """Start a recording."""
        if problem := self._occupied():
            return problem
        try:
            folder = self._new_folder("recording")
            log = (folder / "recorder.log").open("wb")
            values = {"output": str(folder / "bag"), **self.present}
            (folder / "params.yaml").write_text(yaml.safe_dump({"/recorder": {"ros__parameters": values}}), "utf-8")
        except OSError as error:
            return f"{self.output}: {error.strerror}"
        remaps = ("-r", "__node:=recorder", "-r", "__ns:=/", "--enclave", "/recorder")
        words = command("nodes.recorder.node", "--ros-args", *remaps, "--params-file", str(folder / "params.yaml"))
        # It watches its standard input, and ends the recording well if the panel dies.
        environment = {**os.environ, "EXO_GRAVITY_SUPERVISED": "1"}
        with log:
            self._recorder = await asyncio.create_subprocess_exec(
                *words, stdin=PIPE, stdout=log, stderr=log, env=environment, start_new_session=True
            )
        self._folder, self._began = folder, self._clock()
        return ""

    async def stop_recording(self) -> str:
        """End the recording; it stays if a trial needs it."""
        if self._is_in_trial():
            return "a trial is running: stop the trial"
        process, self._recorder = self._recorder, None
        if process is None:
            return "nothing is being recorded"
        process.terminate()
        try:
            code = await asyncio.wait_for(process.wait(), STOP_TIMEOUT)
        except asyncio.TimeoutError:
            process.kill()
            return "the recorder did not end and was killed"
        return "" if code == 0 else f"the recorder ended with exit code {code}: see {self._folder}/recorder.log"

    async def save(self) -> str:
        """Write the parameters in force as YAML, from which `launcher` starts."""
        nodes = self._device.parameters().items()
        given = {node: values for node, values in nodes if values and not node.endswith(("/recorder", "/panel"))}
        content = {node: {"ros__parameters": nested(values)} for node, values in given.items()}
        if not content:
            return "no node has been found yet"
        text = yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=120)
        try:
            folder = self._new_folder("parameters")
            (folder / "params.yaml").write_text(text, encoding="utf-8")
        except OSError as error:
            return f"{self.output}: {error.strerror}"
        self._saved = str(folder / "params.yaml")
        return ""

    async def trial(self, name: str) -> str:
        """Start a trial."""
        if self._is_in_trial():
            return "a trial is running already"
        states = self._device.states()
        if not states or set(states.values()) != {State.ACTIVE.value}:
            return "a trial starts when every arm is active"
        path = self.trials[name]
        try:
            script = TrialScript.parse(yaml.safe_load(path.read_text(encoding="utf-8")))
        except (OSError, yaml.YAMLError, ParameterError) as error:
            return f"{path}: {error}"
        if problem := self._occupied():
            return problem
        guided = not any(node.endswith("/simulator") for node in self._device.parameters())
        attach = ("--attach", "guided" if guided else "simulated", "--output", str(self.output))
        words = command("tools.trial", str(path), *attach, *(f"--{key}={text}" for key, text in self.present.items()))
        self._trial = await asyncio.create_subprocess_exec(
            *words, stdin=DEVNULL, stdout=PIPE, stderr=PIPE, start_new_session=True
        )
        steps = [{"action": s.action, "value": list(s.value), "duration": s.duration} for s in script.steps]
        self._progress = {"phase": "running", "name": script.name, "guided": guided, "steps": steps, "step": -1}
        self._folder, self._began = None, self._clock()
        self._following = asyncio.create_task(self._follow(self._trial, "" if guided else str(path)))
        return ""

    async def stop_trial(self) -> str:
        """End the trial early; what was recorded is reported."""
        if self._trial is None or self._progress["phase"] != "running":
            return "no trial is running"
        self._trial.terminate()
        return ""

    async def _follow(self, trial: asyncio.subprocess.Process, script: str) -> None:
        """Follow the trial's lines to its report; the virtual wearers perform `script`, '' for none, until it ends."""
        assert trial.stdout and trial.stderr
        errors = asyncio.create_task(trial.stderr.read())
        refused, performs = "", False
        async for line in trial.stdout:
            news = json.loads(line)
            self._progress = {**self._progress, **news}
            if "folder" in news:
                self._folder = Path(news["folder"])
            elif script and "step" in news:  # the recorder records
                if refused := await self._device.perform(script):
                    trial.terminate()
                script, performs = "", True
            elif performs and ("phase" in news or set(self._device.states().values()) != {State.ACTIVE.value}):
                await self._device.perform("")
                performs = False
        if performs:  # the trial was killed
            await self._device.perform("")
        lines = (await errors).decode(errors="replace").strip().splitlines()
        failed = await trial.wait() not in (0, 1)
        name, problem = self._progress["name"], refused or self._progress.get("problem", "")
        problem = problem or (lines[-1] if failed and lines else "")
        key = ""
        if self._folder and (self._folder / "report.html").is_file():
            key = self._folder.relative_to(self.output).as_posix()
        self._progress = {"phase": "done", "name": name, "problem": problem, "report": key}
        self._note(f"trial {name} has ended: {problem or 'done'}")

    def _is_recording(self) -> bool:
        return self._recorder is not None and self._recorder.returncode is None

    def _is_in_trial(self) -> bool:
        return self._following is not None and not self._following.done()

    def _occupied(self) -> str:
        """Return why no recording can start, or ''."""
        if self._is_recording() or self._is_in_trial():
            return "a recording is running already"
        return "another recorder is running already" if "/recorder" in self._device.parameters() else ""

    def _new_folder(self, name: str) -> Path:
        """Create and return a folder with a new name. Raises OSError."""
        stem = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
        for number in itertools.count(1):
            folder = self.folder / (stem if number == 1 else f"{stem}_{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir(parents=True)
                break
        return folder


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


def command(module: str, *args: str) -> list[str]:
    """Return the command line of an executable of the package, which need not be on the PATH."""
    return [sys.executable, "-c", f"from exo_gravity.{module} import main; raise SystemExit(main())", *args]
