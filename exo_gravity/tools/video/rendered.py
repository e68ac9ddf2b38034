"""Writes a clip with its progress on the screen; MuJoCo and the encoder are imported here, after OpenGL is chosen."""

from __future__ import annotations

from typing import TYPE_CHECKING

from exo_gravity.bag.content import Bag
from exo_gravity.tools.video.output import Clip, select_backend

if TYPE_CHECKING:
    from rich.console import Console


def write(bag: Bag, clip: Clip, console: Console) -> None:
    """Write the clip of a recording, and print where it is. Raises DataError."""
    select_backend()
    from rich.progress import Progress

    from exo_gravity.tools.video.clip import write_clip

    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"drawing {clip.path.name}", total=None)
        write_clip(bag, clip, lambda done, count: progress.update(task, completed=done, total=count))
    console.print(f"Clip: {clip.path}", markup=False, soft_wrap=True)
