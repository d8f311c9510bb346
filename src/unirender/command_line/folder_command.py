"""`unirender decompose` of a folder of pictures: what it reads, and what it says of all of them together."""

import contextlib
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from unirender.command_line.input_picture import read_input
from unirender.command_line.remarks import frame_remarks
from unirender.errors import UnirenderError
from unirender.folders import FolderResult, decompose_folder, list_pictures, write_summary
from unirender.frames import temporal_difference
from unirender.new_folders import SUMMARY_FILE
from unirender.pictures import Picture
from unirender.pipelines.inputs import as_picture
from unirender.pipelines.results import Decomposition
from unirender.system.notices import notice
from unirender.system.wording import counted

if TYPE_CHECKING:
    from unirender.command_line.commands import Decompose
    from unirender.pipelines.unirender_pipeline import UniRenderPipeline


@dataclass
class Reader:
    """Reads the pictures of a folder one by one, and remembers the remarks on them.

    Attributes:
        command: whose options say how.
        side: of the network's square, pixels.
        remarks: by kind, those so far, each with its picture's name.
    """

    command: "Decompose"
    side: int
    remarks: dict[str, list[str]] = field(default_factory=dict)

    def __call__(self, path: Path, mask: Path | None) -> Picture:
        """A picture with its mask and its remarks.

        Raises:
            UnirenderError: it cannot be read, or the network would refuse it.
        """
        samples = self.command.model.samples
        taken = self.command.decomposition.bytes_a_pixel(samples)
        picture, said = read_input(path, mask, bytes_a_pixel=taken, samples=samples)
        try:
            as_picture(picture.image_srgb, picture.mask)
        except UnirenderError as error:
            raise UnirenderError(f"{path}: {error}") from error
        assert picture.mask is not None, "`read_input` gives one"
        said |= self.command.model.camera_remarks(picture)
        said |= frame_remarks(picture.mask, self.side, self.command.decomposition.tile)
        for kind, remark in said.items():
            self.remarks.setdefault(kind, []).append(f"{path.name}: {remark}")
        return dataclasses.replace(picture, remarks=said)

    def notices(self) -> None:
        """Says each kind of remark once."""
        for first, *others in self.remarks.values():
            notice(first + (f" ({len(others)} more likewise)" if others else ""))


def run_folder(command: "Decompose") -> int:
    """Returns the exit status: 1 where a picture failed.

    Raises:
        UnirenderError: an option does not go with a folder, there are no pictures, or nothing can be written.
    """
    source, output, masks = command.input.picture, command.out.output, command.input.mask
    if command.export is not None:
        raise UnirenderError(f"{source}: is a folder, expected one picture for --export")
    if masks is not None and not masks.exists():
        raise UnirenderError(f"--mask {masks}: no such file or folder, expected a picture or a folder of them")
    pictures = list_pictures(source)
    pipeline = command.model.load()
    read = Reader(command, command.model.side(pipeline))
    settings = {"command": "decompose", **command.decomposition.settings, **command.model.provenance(pipeline)}
    settings["fov"] = command.model.fov
    with progress_of(len(pictures), command.model.progress) as watch:
        pipeline.set_progress_bar_config(disable=True)  # one bar, of the pictures
        found = decompose_folder(
            pictures,
            output,
            read=read,
            decompose=lambda batch: decompose_batch(command, pipeline, batch),
            settings=settings,
            masks=masks,
            overwrite=command.out.overwrite,
            watch=watch,
        )
    facts: dict[str, Any] = {**settings, **command.input.files}
    if command.frames:
        results = [(path, output / path.name) if path.name in found.figures else None for path in pictures]
        facts["temporal_difference"] = temporal_difference(results)
    if found.figures or not (output / SUMMARY_FILE).exists():  # where all failed, that of an earlier run stays
        write_summary(output, found, facts)
    read.notices()
    say_result(output, found, facts.get("temporal_difference"))
    return 1 if found.failed else 0


@contextlib.contextmanager
def progress_of(count: int, shown: bool) -> Iterator[Callable[[int], None]]:
    """A bar, or lines in a log, if `shown`; gives what is told how many pictures are done."""
    from rich.console import Console

    from unirender.system.run_progress import progress_bar

    with progress_bar(Console(stderr=True, quiet=not shown), transient=True) as bar:
        task = bar.add_task("pictures", total=count)
        yield lambda done: bar.update(task, completed=done)


def decompose_batch(command: "Decompose", pipeline: "UniRenderPipeline", batch: list[Picture]) -> list[Decomposition]:
    """A few pictures at once, each with the noise that it would have alone."""
    how: dict[str, Any] = command.model.sampling() | {"generator": command.model.generators(len(batch))}
    return pipeline.decompose_batch(
        [picture.image_srgb for picture in batch],
        [picture.mask for picture in batch],
        cameras=[command.model.camera(picture) for picture in batch],
        **command.decomposition.settings,
        **how,
    )


def say_result(output: Path, found: FolderResult, changes: dict[str, float] | None) -> None:
    """Prints how many pictures are done, and why others are not.

    Args:
        output: the folder of the results.
        found: what became of the pictures.
        changes: of a film, from one frame to the next.
    """
    for reason in found.failed.values():
        notice(f"error: {reason}")
    failed = f", {len(found.failed)} failed" if found.failed else ""
    print(f"{output}: {counted(len(found.figures), 'picture')} ({found.kept} of them from before){failed}")
    if changes is not None:
        shown = ", ".join(f"{name} {value:.4f}" for name, value in changes.items() if name != "pairs")
        print(f"mean change between {counted(int(changes['pairs']), 'pair')} of frames: {shown or 'none to compare'}")
