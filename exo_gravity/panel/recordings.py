# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
"""Recordings, trials, saved parameters and the subjects: folders below `output`, SUBJECT/DATE/TRIAL.

A recording is made by the package's `recorder`, a trial by its command `trial --attach`: processes, which this module
starts, follows and ends. A simulated device's virtual wearer or a person performs the script of a trial. It starts with
every arm active and ends early when one is not. A wearer's file, SUBJECT/wearer.yaml, holds the parameters of
`compensator` that belong to the subject. Folders of recordings without a subject lie directly below `output`.
"""

import asyncio
import contextlib
import itertools
import json
import os
import re
import shutil
from asyncio.subprocess import DEVNULL, PIPE
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import yaml

from exo_gravity.core.errors import ParameterError
from exo_gravity.core.params import ROS_PARAMETERS
from exo_gravity.core.safety.command import State
from exo_gravity.lab.bag.content import Session, check_text
from exo_gravity.lab.inputs.parameter_file import dumped, text_of
from exo_gravity.lab.processes import Launcher, program
from exo_gravity.panel.control import OF_SUBJECT
from exo_gravity.sim.script import TrialScript

RECORDER, WEARER, REPORT = "/recorder", "wearer.yaml", "report.html"
FILES = {"report": REPORT, "recording": "bag/*.mcap"}  # of a trial's folder that a page may open
FOLDER_NAME = re.compile(r"(.+)_(\d{4})(\d\d)(\d\d)_(\d\d)(\d\d)(\d\d)(_\d+)?")  # of a recording or trial
MOST_LISTED = 200  # recordings that the page lists
# Programs that show a recording on this computer: the command of each, which the file follows.
PROGRAMS = {"PlotJuggler": ["plotjuggler", "-d"], "Foxglove": ["foxglove-studio"]}


def programs() -> dict[str, list[str]]:
    """Return the commands of those PROGRAMS that are installed; none without a screen.

    ROS installs its PlotJuggler outside PATH.
    """
    if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return {}
    prefixes = filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    folders = (os.environ.get("PATH", ""), *(f"{prefix}/lib/plotjuggler" for prefix in prefixes))
    found = {name: shutil.which(words[0], path=os.pathsep.join(folders)) for name, words in PROGRAMS.items()}
    return {name: [path, *PROGRAMS[name][1:]] for name, path in found.items() if path}


def _runs(recorder: Launcher | None) -> bool:
    return recorder is not None and recorder.exit_code(RECORDER) is None


class Recordings:
    """`files` of `exo_gravity.panel.control.Control`: a request of a page is a coroutine function of the same name.

    Each returns '' or why it was not carried out, or raises ParameterError or OSError. device: the arms. It has
    `parameters()` of every node by full name, `states()` of each arm (None if its bridge is silent), `mark(text)`,
    which publishes a marker, and a coroutine function `perform(path)` that lets the virtual wearers perform a script,
    '' for none; both return '' or why not. note: called with a sentence for the log. clock: monotonic s.
    """

    def __init__(
        self, output: str, scripts: Path, device: Any, note: Callable[[str], None], clock: Callable[[], float]
    ) -> None:
        self.trials = {path.stem: path for path in sorted(scripts.glob("*.yaml"))}  #: the scripts, by name
        self._output = Path(output).expanduser().resolve()
        self._device, self._note, self._clock = device, note, clock
        self._present = {"subject": "", "protocol": "", "note": ""}  # `Session` of what is recorded from now on
        self._wearer: dict[str, Any] = {}  # parameters in the subject's file
        self._recorder: Launcher | None = None
        self._folder: Path | None = None
        self._began = 0.0
        self._trial: asyncio.subprocess.Process | None = None
        self._following: asyncio.Task[None] | None = None
        self._progress: dict[str, Any] = {"phase": "none"}
        self._saved = ""

    def state(self) -> dict[str, Any]:
        """Return what the page shows."""
        recorder = self._recorder  # requests, on another thread, change it
        is_on = _runs(recorder) or self._progress["phase"] == "running"
        recording = {
            "on": is_on,
            "foreign": not is_on and RECORDER in self._device.parameters(),
            "folder": str(self._folder or "") if is_on else "",
            "seconds": round(self._clock() - self._began) if is_on else 0,
            "problem": self._ending(recorder) if recorder and not is_on else "",
        }
        folder = str(self._output / self._present["subject"])
        session = {**self._present, "folder": folder, "wearer": self._wearer}
        return {"recording": recording, "trial": self._progress, "saved": self._saved, "session": session}

    def close(self) -> None:
        """End the recording and the trial."""
        if self._recorder is not None:
            self._recorder.process(RECORDER).terminate()
        if self._trial is not None and self._trial.returncode is None:
            self._trial.terminate()

    async def record(self) -> str:
        """Start a recording."""
        if problem := self._occupied():
            return problem
        folder = self._new_folder("recording")
        params, log = folder / "params.yaml", (folder / "recorder.log").open("w", 1, encoding="utf-8")
        params.write_text(text_of({RECORDER: {"output": str(folder / "bag"), **self._present}}), encoding="utf-8")
        self._recorder = Launcher(params, lambda _node, line: log.write(f"{line}\n"))
        self._recorder.start()
        self._folder, self._began = folder, self._clock()
        return ""

    async def stop_recording(self) -> str:
        """End the recording; it stays if a trial needs it."""
        if self._is_in_trial():
            return "a trial is running: stop the trial"
        launcher, self._recorder = self._recorder, None
        if launcher is None:
            return "nothing is being recorded"
        await asyncio.to_thread(launcher.stop)
        return self._ending(launcher) if launcher.exit_code(RECORDER) else ""

    async def save(self) -> str:
        """Write the parameters in force as YAML, from which `launcher` starts."""
        content = {
            node: {name: value for name, value in sorted(values.items()) if value != [] and name not in ROS_PARAMETERS}
            for node, values in self._device.parameters().items()
            if values and not node.endswith((RECORDER, "/panel"))
        }
        if not content:
            return "no node has been found yet"
        path = self._new_folder("parameters") / "params.yaml"
        path.write_text(text_of(content), encoding="utf-8")  # without empty lists, which ROS cannot read
        self._saved = str(path)
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
            script = TrialScript.read(path)
        except ParameterError as error:
            return f"{path}: {error}"
        if problem := self._occupied():
            return problem
        guided = not any(node.endswith("/simulator") for node in self._device.parameters())
        attach = ("--attach", "guided" if guided else "simulated", "--output", str(self._output))
        words = [str(path), *attach, *(f"--{key}={text}" for key, text in self._present.items())]
        steps = [{"action": s.action, "value": list(s.value), "duration": s.duration} for s in script.steps]
        self._progress = {"phase": "running", "name": script.name, "guided": guided, "steps": steps, "step": -1}
        self._folder, self._began, self._recorder, self._trial = None, self._clock(), None, None
        self._following = asyncio.create_task(self._follow(words, "" if guided else str(path)))
        return ""

    async def stop_trial(self) -> str:
        """End the trial early; what was recorded is reported."""
        if self._trial is None or self._progress["phase"] != "running":
            return "no trial is running"
        self._trial.terminate()
        return ""

    async def _follow(self, words: Sequence[str], script: str) -> None:
        """Start a trial, and follow its lines to its report; the virtual wearers perform `script`, '' for none."""
        trial = self._trial = await asyncio.create_subprocess_exec(
            *program("exo_gravity.tools.trial", "trial"),
            *words,
            stdin=DEVNULL,
            stdout=PIPE,
            stderr=PIPE,
            start_new_session=True,
        )
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
        key = self._key(self._folder, REPORT) if self._folder else ""
        is_stopped = self._progress.get("stopped", False)
        self._progress = {"phase": "done", "name": name, "problem": problem, "stopped": is_stopped, "report": key}
        self._note(f"trial {name} has ended: {problem or 'done'}")

    async def session(self, **present: str) -> str:
        """Make this subject, protocol and note the present session, and read the wearer's file."""
        path = self._output / Session(**present).subject / WEARER
        try:
            content = yaml.safe_load(path.read_text(encoding="utf-8")) if present["subject"] and path.is_file() else {}
            self._wearer = {name: OF_SUBJECT[name].check(value) for name, value in content.items()}
        except (yaml.YAMLError, AttributeError, KeyError) as error:
            return f"{path} must be a mapping of {', '.join(OF_SUBJECT)} ({' '.join(str(error).split())})"
        self._present = present
        return ""

    async def keep_wearer(self) -> str:
        """Write the wearer's data and workspace in force to the subject's file."""
        nodes: dict[str, dict[str, Any]] = self._device.parameters()
        in_force = next((values for node, values in nodes.items() if node.endswith("/compensator")), {})
        if not self._present["subject"] or not in_force:
            return "no subject is chosen" if in_force else "no arm has been found yet"
        if in_force.get("wearer.body_mass") == 0.0:
            return "no wearer has been entered"
        wearer = {name: in_force[name] for name in OF_SUBJECT if name in in_force}
        folder = self._output / self._present["subject"]
        folder.mkdir(parents=True, exist_ok=True)
        (folder / WEARER).write_text(dumped(wearer), encoding="utf-8")
        self._wearer = wearer
        return ""

    async def marker(self, text: str) -> str:
        """Set a marker in the recording."""
        return str(self._device.mark(check_text("text", text) or "marker"))

    def past(self) -> dict[str, list[Any]]:
        """Return the codes of all subjects, and the recordings and trials, the newest first."""
        found = self._found()
        kept = {path.parent.name for path in self._output.glob(f"*/{WEARER}")}
        return {
            "subjects": sorted(kept | {entry["subject"] for entry, _ in found} - {""}),
            "past": [{**entry, **self._content(path)} for entry, path in found[:MOST_LISTED]],
        }

    def _found(self) -> list[tuple[dict[str, Any], Path]]:
        """Return what the path of each recording and trial says, and the path, the newest first."""
        found: list[tuple[dict[str, Any], Path]] = []
        for path in (*self._output.glob("*_*/"), *self._output.glob("*/*-*-*/*_*/")):
            if (match := FOLDER_NAME.fullmatch(path.name)) and (self._key(path, REPORT) or self._key(path, "bag")):
                name, year, month, day, hour, minute, second, _ = match.groups()
                *subject, _ = path.relative_to(self._output).parts
                when = f"{year}-{month}-{day} {hour}:{minute}:{second}"
                found.append(({"subject": "".join(subject[:1]), "trial": name, "when": when}, path))
        return sorted(found, key=lambda each: each[0]["when"], reverse=True)

    def _content(self, path: Path) -> dict[str, Any]:
        """Return what the folder `path` of a trial has: what its report says, and the names of report and recording."""
        said: dict[str, Any] = {"verdict": "", "protocol": "", "seconds": None}
        with contextlib.suppress(OSError, ValueError):  # none was written, or only a part
            said |= json.loads((path / "report.json").read_text(encoding="utf-8"))
        return {**said, "report": self._key(path, REPORT), "folder": self._key(path, "bag")}

    async def open(self, name: str, program: str) -> str:
        """Show a recording of the list in one of `programs`, which outlives the panel."""
        if not {*self._device.states().values()} <= {State.DISABLED.value, State.FAULT.value}:
            # Such a program may load the computer that carries them.
            return "a program is started while every arm is off"
        command, listed = programs().get(str(program)), [self._key(path, "bag") for _, path in self._found()]
        path = self.file(name, FILES["recording"]) if name and name in listed[:MOST_LISTED] else None
        if not (command and path):
            raise ParameterError("name, program", [name, program], "a recording of the list and an installed program")
        starter = await asyncio.create_subprocess_exec(
            "setsid", "--fork", *command, str(path), stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL
        )
        return "" if await starter.wait() == 0 else f"{program} could not be started"

    def file(self, name: str, pattern: str) -> Path | None:
        """Return the first file of that pattern in the folder `name` below `output`; None without one."""
        with contextlib.suppress(OSError, ValueError, NotImplementedError):  # no file can have that name
            path = next((path.resolve() for path in sorted((self._output / name).glob(pattern))), self._output)
            return path if path.is_relative_to(self._output) and path.is_file() else None
        return None

    def _key(self, folder: Path, part: str) -> str:
        """Return the name of this folder for `file`, '' if it has no such part."""
        return folder.relative_to(self._output).as_posix() if (folder / part).exists() else ""

    def _ending(self, recorder: Launcher) -> str:
        return f"the recorder ended with exit code {recorder.exit_code(RECORDER)}: see {self._folder}/recorder.log"

    def _is_in_trial(self) -> bool:
        return self._following is not None and not self._following.done()

    def _occupied(self) -> str:
        """Return why no recording can start, or ''."""
        if _runs(self._recorder) or self._is_in_trial():
            return "a recording is running already"
        return "another recorder is running already" if RECORDER in self._device.parameters() else ""

    def _new_folder(self, name: str) -> Path:
        """Create and return a folder with a new name, of the present session. Raises OSError."""
        of_today = self._output / Session(**self._present).folder(datetime.now())
        stem = f"{name}_{datetime.now():%Y%m%d_%H%M%S}"
        for number in itertools.count(1):
            folder = of_today / (stem if number == 1 else f"{stem}_{number}")
            with contextlib.suppress(FileExistsError):
                folder.mkdir(parents=True)
                break
        return folder
