"""What the command line says of a line that is wrong, and of Ctrl-C."""

import errno
import importlib
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import diffusers
import numpy as np
import pytest
from optimizer_runs import rendered_views, truth

from unirender import cli
from unirender.command_line import process_ends
from unirender.command_line.parse import parse
from unirender.command_line.process_ends import open_streams
from unirender.system.ends import Ended, causes, interrupted
from unirender.system.system_errors import refused_by_system
from unirender.visualization import write_png
from unirender_reference.optimize.files.export import write_solution
from unirender_reference.optimize.files.folder import write_views


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[object, str]:
    """(exit status, what was printed to stderr)."""
    with pytest.raises(SystemExit) as stopped:
        cli.main([*arguments])
    return stopped.value.code, capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            ["optimize", "x", "--out", "y", "--texure-size", "3"],
            "--texure-size: no option of `unirender optimize`; did you mean --texture-size? "
            "`unirender optimize --help` lists what it takes",
        ),
        (
            ["bench", "race", "--objcts=4", "--zzzzzzzz"],
            "--objcts, --zzzzzzzz: no option of `unirender bench race`; did you mean --objects? "
            "`unirender bench race --help` lists what it takes",
        ),
        (  # its help names `unirender bench run --out`
            ["bench", "report", "--out", "x", "y"],  # "missing value for argument 'command.folder'", it was said
            "--out: no option of `unirender bench report`; `unirender bench report --help` lists what it takes",
        ),
        (
            ["bench", "--limit", "3", "run"],
            "--limit: no option of `unirender bench`; `unirender bench --help` lists what it takes",
        ),
        (  # of the same meaning, and no --seed
            ["dataset", "--out", "x", "--size", "64"],
            "--size: no option of `unirender dataset`; did you mean --resolution? "
            "`unirender dataset --help` lists what it takes",
        ),
        (
            ["relight", "x", "--light", "y"],
            "--light: no option of `unirender relight`; did you mean --environment? "
            "`unirender relight --help` lists what it takes",
        ),
        (
            ["lights", "--output", "x"],
            "--output: no option of `unirender lights`; did you mean --export? "
            "`unirender lights --help` lists what it takes",
        ),
        (["optimise"], "optimise: no command of `unirender`; did you mean optimize? `unirender --help` lists them"),
        (
            ["bench", "tabels", "--out", "x"],
            "tabels: no command of `unirender bench`; did you mean tables? `unirender bench --help` lists them",
        ),
        (["bake"], "bake: no command of `unirender`; `unirender --help` lists them"),
        (["doctor", "now"], "now: not expected by `unirender doctor`; `unirender doctor --help` lists what it takes"),
        (["optimize", "x", "--out", "y", "--shape.cells", "0"], "--shape.cells 0: expected 8 or more"),
        (["bench", "unknown-mesh", "--shape.depth", "1"], "--shape.depth 1: expected 2 or more"),
        (
            ["bench", "warm-start", "--single.steps", "1"],
            "--single.steps 1, --single.noise 0.1 0.05 0.025: expected as many numbers in both, a pair for each stage",
        ),
        (  # the picture would be the folder that one is in
            ["decompose", "", "--output", "y"],
            "after decompose: got an empty word, expected a value; is a variable of the shell not set?",
        ),
        (
            ["bench", "run", "--out="],
            "--out=: got an empty word, expected a value; is a variable of the shell not set?",
        ),
    ],
)
def test_what_a_command_does_not_take(arguments: list[str], line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, *arguments) == (2, f"unirender: error: {line}\n")


@pytest.mark.parametrize(
    "arguments",
    [["bench", "verdict", "results", "--format", "html"], ["reference", "sweep", "--split", "tset"]],
)
def test_a_value_is_not_taken_for_a_command(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """The choices of an option stand in braces, too."""
    status, told = said(capsys, *arguments)
    assert (status, "no command of" in told, arguments[-1] in told) == (2, False, True)


@pytest.mark.parametrize("columns", [40, 80, 250])
def test_an_option_is_known_however_wide_the_terminal_is(
    columns: int, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wide one gets several columns of options, of which those of the first were known."""
    monkeypatch.setenv("COLUMNS", str(columns))
    told = said(capsys, "optimize", "x", "--out", "y", "--refine.no-decorrelated", "--single.steps", "no")[1]
    assert "no option of" not in told
    assert "--single.steps" in told


def test_what_the_machine_does_not_have(capsys: pytest.CaptureFixture[str]) -> None:
    """Not the command line is wrong then: a larger machine could do it."""
    status, line = said(capsys, "optimize", "x", "--out", "y", "--shape.cells", "100000")
    assert status == 1
    assert line.startswith("unirender: error: --shape.cells 100000: would take about 167,643,093 GiB of memory")


def test_what_the_system_refuses(capsys: pytest.CaptureFixture[str]) -> None:
    """No error of ours: one sentence that says what to do, whatever command and file it is."""
    long = "a" * 300
    refused = f"{long}: cannot be read or written ({os.strerror(errno.ENAMETOOLONG)}); shorten the name"
    assert said(capsys, "bench", "tables", long) == (1, f"unirender: error: {refused}\n")


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(errno.ENOSPC, "No space left"), "a file or the standard output: cannot be read or written (No space"),
        (PermissionError(errno.EACCES, "Denied", b"x.png"), "x.png: cannot be read or written (Denied); allow it"),
        (FileNotFoundError(errno.ENOENT, "No such file"), None),  # where we looked for it ourselves
        (
            RuntimeError("Symlink loop from '/a/b'"),
            "/a/b: cannot be read or written (Too many levels of symbolic links",
        ),
        (RuntimeError("Symlink"), None),
    ],
)
def test_an_error_of_the_system_and_one_of_ours(error: Exception, line: str | None) -> None:
    said = refused_by_system(error)
    assert said is None if line is None else str(said).startswith(line)


def test_a_folder_that_is_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    assert "is not there any more" in str(refused_by_system(FileNotFoundError(errno.ENOENT, "No such file")))
    tmp_path.mkdir()


def test_closed_standard_streams_lead_nowhere(tmp_path: Path) -> None:
    """Neither does printing fail, nor do errors go to where results are expected."""
    script = '"$0" -m unirender decompose none.png --output y 2>&-; "$0" -m unirender --help >&-'
    run = subprocess.run(["sh", "-c", script, sys.executable], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (run.returncode, run.stdout, run.stderr) == (0, "", "")


def test_letters_that_the_output_lacks_are_printed_by_their_number(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not every terminal has the arrows of tables and the bullets of help; not every file's name is UTF-8."""
    for encoding, errors in (("ascii", "strict"), ("latin-1", "surrogateescape"), ("utf-8", "strict")):
        printed = io.BytesIO()
        with io.TextIOWrapper(printed, encoding, errors) as output:
            monkeypatch.setattr(sys, "stdout", output)
            open_streams()
            print("b\udcfc \u2191", flush=True)
            assert printed.getvalue().decode(encoding).startswith("b\\udcfc ")
        monkeypatch.undo()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (["edit", "x.png", "--output", "y", "--metallic", "much"], "--metallic much: expected a number"),
        (["edit", "x.png", "--output", "y", "--samples=1.5"], "--samples 1.5: expected a whole number"),
        (["figures", "--values", "0", "o.5", "--out", "y"], "--values o.5: expected a number"),
        (["edit", "x.png", "--output", "y", "--sampler", "euler"], "--sampler euler: expected one of ddim, unipc"),
        (["edit", "x.png", "--output", "y", "--sampler", "None"], "--sampler None: expected one of ddim, unipc"),
        (
            ["optimize", "x", "--out", "y", "--init", "unirendr"],
            "--init unirendr: expected one of none, unirender; did you mean unirender?",
        ),
        (
            ["bench", "ls", "Tabels"],
            "Tabels: expected one of suites, tables, methods, metrics, variants; did you mean tables?",
        ),
        (
            ["bench", "speed", "--parts", "start", "netwrk"],
            "--parts netwrk: expected one of network, mitsuba, start, training, overfit; did you mean network?",
        ),
        (["edit", "x.png", "--output", "--metallic", "1"], "--output: expected a value after it, got none"),
    ],
)
@pytest.mark.parametrize("columns", ["40", "120"])
def test_what_is_no_value_of_an_option(
    arguments: list[str],
    line: str,
    columns: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One line as elsewhere, not a box that ends with the help of `unirender` alone."""
    monkeypatch.setenv("COLUMNS", columns)
    assert said(capsys, *arguments) == (2, f"unirender: error: {line}\n")


@pytest.mark.parametrize(
    ("arguments", "end"),
    [
        (["train", "--data", "x", "--preset", "tinny"], "did you mean tiny?"),
        (["bench", "run", "--suite", "Standrd"], "did you mean standard?"),
        (["dataset", "--recipe", "train-46", "--out", "y"], "did you mean train-64 or train-128?"),
        (["bench", "tables", "--variant", "masked-liner", "x"], "did you mean linear or aligned?"),
    ],
)
def test_a_name_that_is_nearly_right(arguments: list[str], end: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said(capsys, *arguments)[1].endswith(f"; {end}\n")


def test_an_option_may_be_none_where_its_default_is_another(capsys: pytest.CaptureFixture[str]) -> None:
    passes = parse(cli.Command, ["reference", "passes", "--out", "x", "--roughness", "None"], "unirender", "").command
    assert (passes.roughness, passes.metallic) == (None, 0.5)
    with pytest.raises(SystemExit):
        cli.main(["reference", "passes", "--help"])
    assert "--roughness FLOAT" in capsys.readouterr().out


def test_a_missing_command_or_option_is_told_by_the_parser(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, word in (([], "doctor"), (["optimize", "x"], "--out"), (["bench"], "warm-start")):
        status, text = said(capsys, *arguments)
        assert status == 2
        assert word in text
        assert text.count("For full helptext") == 1


def test_help_has_titles_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("ingredients", "race", "unknown-mesh", "warm-start"):
        with pytest.raises(SystemExit) as stopped:
            cli.main(["bench", name, "--help"])
        text = capsys.readouterr().out
        assert stopped.value.code == 0
        assert "command" not in [line.split()[1].split(".")[0] for line in text.splitlines() if line.startswith("╭")]
        assert "minutes on 2 cores" in " ".join(text.split())
        assert "(default: )" not in text


def _raised(error: BaseException, cause: BaseException | None, handled: BaseException | None) -> BaseException:
    """The error as it is caught, with what it came of."""
    try:
        if handled is None:
            raise error from cause
        try:
            raise handled
        except BaseException:
            raise error  # noqa: B904 - as Dr.Jit does, without "from"
    except BaseException as caught:
        return caught


def test_ctrl_c_is_found_behind_other_errors() -> None:
    stop = KeyboardInterrupt()
    assert interrupted(stop)
    assert interrupted(_raised(RuntimeError("dr.while_loop(): ..."), stop, None))
    assert interrupted(_raised(RuntimeError("clean-up"), None, stop))
    assert not interrupted(_raised(RuntimeError("dr.while_loop(): ..."), ValueError("nan"), None))
    inner = _raised(RuntimeError("b"), stop, None)
    assert [type(error) for error in causes(_raised(OSError(), inner, None))] == [OSError, RuntimeError, type(stop)]


@pytest.mark.parametrize(("folder", "more"), [(True, "; run the same command again to go on"), (False, "")])
def test_ctrl_c_in_a_loop_of_the_renderer(
    folder: bool, more: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(command: object) -> int:
        raise RuntimeError("dr.while_loop(): encountered an exception (see above).") from KeyboardInterrupt()

    monkeypatch.setattr(cli, "run", run)
    given = tmp_path if folder else tmp_path / "one.png"
    assert said(capsys, "optimize", str(given), "--out", "y") == (130, f"unirender: interrupted{more}\n")


def heed_ctrl_c() -> None:
    """A process inherits that Ctrl-C is ignored, where the tests run in the background of a shell."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def heed_hang_up() -> None:
    """As `heed_ctrl_c`, where the tests run under nohup."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.mark.long
def test_ctrl_c_in_a_refinement(tmp_path: Path) -> None:
    solution = truth()
    write_views(rendered_views(solution, 2, 0, 16), tmp_path / "views")
    write_solution(solution, tmp_path)
    out = tmp_path / "out"
    options = ["--transport.no-enabled", "--refine.iterations", "100000", "--texture-size", "16", "--light-rows", "8"]
    command = [sys.executable, "-m", "unirender.cli", "optimize", str(tmp_path / "views"), "--out", str(out), *options]
    command += ["--mesh", str(tmp_path / "mesh.glb")]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, preexec_fn=heed_ctrl_c)
    text = ""
    try:
        while process.poll() is None and not (out / "history.jsonl").exists():
            time.sleep(0.05)
        for _ in range(10):  # native code may swallow one
            process.send_signal(signal.SIGINT)
            try:
                _, text = process.communicate(timeout=10)
                break
            except subprocess.TimeoutExpired:
                continue
    finally:
        process.kill()
    assert process.returncode == 130
    assert text.endswith("unirender: interrupted; run the same command again to go on\n")


# as `python -m unirender`, but that writing a result takes a minute
SLOW_TO_WRITE = """
import time
import unirender.files
from unirender.cli import main
unirender.files.write_exr = lambda *_, **__: time.sleep(60)
main()
"""


@pytest.mark.slow
def test_a_command_that_is_told_to_end_takes_back_what_it_began(tmp_path: Path) -> None:
    write_png(tmp_path / "mug.png", np.full((16, 16, 3), 0.5, np.float32))
    command = [sys.executable, "-c", SLOW_TO_WRITE, "decompose", "mug.png", "--output", "out"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    try:
        while process.poll() is None and not list(tmp_path.glob(".out.*")):
            time.sleep(0.005)
        process.send_signal(signal.SIGTERM)
        _, text = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 128 + signal.SIGTERM
    assert text.endswith("unirender: interrupted\n")
    assert [path.name for path in tmp_path.iterdir()] == ["mug.png"]


# as `python -m unirender`, but that any command works for a minute, with a temporary folder
AT_WORK = """
import tempfile, time
from unirender import cli

def run(command):
    with tempfile.TemporaryDirectory() as folder:
        print(folder, flush=True)
        time.sleep(60)

cli.run = run
cli.main()
"""


def test_every_command_hears_who_tells_it_to_end() -> None:
    """A terminal that closes tells it; batch systems do it by SIGTERM."""
    command = [sys.executable, "-c", AT_WORK, "lights"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=heed_hang_up
    )
    assert process.stdout is not None
    folder = Path(process.stdout.readline().strip())
    assert folder.is_dir(), "it is at work"
    process.send_signal(signal.SIGHUP)
    _, text = process.communicate(timeout=60)
    assert (process.returncode, text) == (128 + signal.SIGHUP, "unirender: interrupted\n")
    assert not folder.exists()


FORKED = """
import multiprocessing, time
from unirender import cli

def run(command):
    context = multiprocessing.get_context("fork")
    at_work = context.Event()

    def work():
        at_work.set()
        time.sleep(60)

    child = context.Process(target=work)
    child.start()
    at_work.wait()
    child.terminate()
    child.join()
    return -child.exitcode

cli.run = run
cli.main()
"""


def test_a_forked_process_ends_as_any_other() -> None:
    """A plug-in's pool printed an error of each of its processes when it ended them."""
    done = subprocess.run([sys.executable, "-c", FORKED, "lights"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (signal.SIGTERM, "")


# as on Windows
FEWER_SIGNALS = """
import signal
del signal.SIGHUP, signal.pthread_kill
import unirender.training.loop.stopping
from unirender import cli
from unirender.command_line import process_ends

cli.run = lambda command: process_ends._Ends().again(signal.SIGINT)
cli.main()
"""


def test_commands_run_where_the_system_has_fewer_signals() -> None:
    """They ended before they began, with an AttributeError."""
    done = subprocess.run([sys.executable, "-c", FEWER_SIGNALS, "lights"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (128 + signal.SIGINT, "unirender: interrupted\n")


@pytest.fixture
def as_before() -> Iterator[None]:
    """What the process does on a signal is afterwards as before."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.signal(number, signal.SIG_DFL) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.usefixtures("as_before")
def test_who_is_told_to_end_again_ends_if_it_has_not(monkeypatch: pytest.MonkeyPatch) -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    process_ends.hear_ends()
    with pytest.raises(Ended) as ended:
        os.kill(os.getpid(), signal.SIGTERM)
    assert ended.value.args == (signal.SIGTERM,)
    os.kill(os.getpid(), signal.SIGTERM)  # to the group: `timeout` does both
    monkeypatch.setattr(process_ends, "PASSED_ON_S", 0.0)
    with pytest.raises(Ended):
        os.kill(os.getpid(), signal.SIGTERM)
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN, "as nohup has it"


@pytest.mark.usefixtures("as_before")
def test_an_import_is_not_interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """torch would abort the process, and trimesh would do without the library."""
    (tmp_path / "takes_the_interrupt.py").write_text(
        "import os, signal\n"
        "try:\n    os.kill(os.getpid(), signal.SIGINT)\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "    swallowed = False\nexcept BaseException:\n    swallowed = True\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    process_ends.hear_ends()
    with pytest.raises(Ended) as ended:
        import_and_wait("takes_the_interrupt")
    assert ended.value.args == (signal.SIGINT,)
    assert not sys.modules.pop("takes_the_interrupt").swallowed
    monkeypatch.setattr(process_ends, "MOST_WAITS", 0)
    importlib.import_module("takes_the_interrupt")
    assert sys.modules.pop("takes_the_interrupt").swallowed, "the twin: nobody waits for ever"


def import_and_wait(name: str) -> None:
    importlib.import_module(name)
    time.sleep(30)


@pytest.mark.slow
def test_the_shipped_model_loads_without_a_bar(capsys: pytest.CaptureFixture[str]) -> None:
    diffusers.utils.logging.enable_progress_bar()
    cli.shipped_pipeline.__wrapped__()
    assert "Loading" not in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [["--version"], ["bench", "unknown-mesh", "--help"]])
def test_who_reads_the_output_may_leave(arguments: list[str]) -> None:
    """As in `unirender ... --help | head`: no error is printed."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        ended = subprocess.run(
            [sys.executable, "-m", "unirender.cli", *arguments], stdout=writer, stderr=subprocess.PIPE, timeout=300
        )
    finally:
        os.close(writer)
    assert (ended.returncode, ended.stderr) == (141, b"")


def test_another_pipe_that_breaks_is_an_error(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def broken(command: object) -> int:
        raise BrokenPipeError("of a worker")

    monkeypatch.setattr(cli, "run", broken)
    with pytest.raises(SystemExit) as stopped:
        cli.main(["doctor"])
    assert stopped.value.code == 1
    assert "BrokenPipeError: of a worker" in capfd.readouterr().err


def test_an_interrupt_while_the_command_is_imported_is_one_line() -> None:
    """Some tenths of a second pass before the command line can say what happens on Ctrl-C."""
    script = """
import signal, sys
class Interrupts:
    def find_spec(self, name, path, target=None):
        if name == "unirender.command_line.commands":
            signal.raise_signal(signal.SIGINT)
sys.meta_path.insert(0, Interrupts())
from unirender.__main__ import main
main()
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, preexec_fn=heed_ctrl_c, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "unirender: interrupted\n")
