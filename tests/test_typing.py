"""Types: each package is typed, every suppression says why, and array shapes are checked while the tests run."""

import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np
import pytest
import shape_checks
from beartype import beartype
from jaxtyping import Float, TypeCheckError

from unirender.color import luminance, unpremultiply

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [
    path
    for folder in ("src", "reference", "evaluation", "tests", "docs")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if "_build" not in path.parts
]
# A suppression, and what has to follow it: the rule in the tool's own syntax, then a separator and a reason.
SUPPRESSION = re.compile(r"#\s*(noqa|type:\s*ignore|pyright:)(?P<rest>.*)$")
REASONED = re.compile(r"^(:\s*[A-Z]+\d+(,\s*[A-Z]+\d+)*|\s*ignore\[[\w, ]+\]|\[[\w, -]+\])\s*(-|#|:|\()\s*\S.{2,}")


def suppressions_without_reason(text: str) -> list[str]:
    """Returns the lines of a source text that silence a checker without a rule or without a reason, or not by the name
    that pyright has for the rule."""
    found = []
    for line in text.splitlines():
        match = SUPPRESSION.search(line)
        if match and (match[1].startswith("type") or not REASONED.match(match["rest"])):
            found.append(line.strip())
    return found


def test_ruff_looks_at_every_source() -> None:
    """An exclusion by a bare name leaves out every folder so called: "results" once hid a room of the scorer."""
    command = [sys.executable, "-m", "ruff", "check", "--show-files", "."]
    shown = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert not {str(path) for path in SOURCES} - set(shown.splitlines())


@pytest.mark.parametrize("package", ["unirender", "unirender_reference", "unirender_evaluation"])
def test_package_is_marked_as_typed(package: str) -> None:
    assert (files(package) / "py.typed").is_file()


def test_every_suppression_names_its_rule_and_its_reason() -> None:
    bad = {
        str(path.relative_to(ROOT)): lines
        for path in SOURCES
        if path != Path(__file__).resolve() and (lines := suppressions_without_reason(path.read_text()))
    }
    assert not bad, f"suppressions without a rule or a reason: {bad}"


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("import x  # noqa", 1),
        ("import x  # noqa: E402", 1),
        ("import x  # noqa: E402 - after the environment is set", 0),
        ("y = f()  # type: ignore", 1),
        ("y = f()  # type: ignore[arg-type]  # Mitsuba has no stubs", 1),
        ("y = f()  # pyright: ignore[reportAttributeAccessIssue]", 1),
        ("y = f()  # pyright: ignore[reportAttributeAccessIssue] - Mitsuba has no stubs", 0),
        ("# pyright: basic", 1),
    ],
)
def test_the_scan_for_suppressions_finds_what_it_should(line: str, found: int) -> None:
    assert len(suppressions_without_reason(line)) == found


def test_array_shapes_are_checked_while_the_tests_run() -> None:
    """The twin of every shape annotation: without the import hook, a wrong type would pass in silence."""
    with pytest.raises(TypeCheckError):
        luminance("not an array")  # pyright: ignore[reportArgumentType] - the point of the test
    assert np.isclose(luminance(np.ones((2, 2, 3), np.float32)), 1.0).all()


def test_an_axis_has_one_size_in_the_arguments_and_the_result_of_a_call() -> None:
    image, mask = np.ones((2, 2, 3), np.float32), np.ones((2, 2, 1), np.float32)
    with pytest.raises(TypeCheckError):
        unpremultiply(image, mask[:1])
    assert unpremultiply(image[:1], mask[:1]).shape == (1, 2, 3)  # the size of the call before is forgotten

    def every(x: Float[np.ndarray, " n"], step: int) -> Float[np.ndarray, " n"]:
        return x[::step]

    looked_at = shape_checks.checked(typechecker=None)(every)
    assert len(looked_at(np.ones(4), 1)) == len(looked_at(np.ones(4), step=1)) == 4
    with pytest.raises(TypeCheckError):
        looked_at(np.ones(4), 2)
    with pytest.raises(TypeCheckError):
        looked_at(np.ones(4), step="1")

    def rows(count: int) -> Float[np.ndarray, "{count} 3"]:
        return np.ones((2, 3))

    looked_at = shape_checks.checked(typechecker=beartype)(rows)
    assert len(looked_at(2)) == 2
    with pytest.raises(TypeCheckError):
        looked_at(3)


class _Pair(NamedTuple):
    first: Any
    second: Any


class _Named(Protocol):
    name: str


class _Thing:
    """Of no name, unless it is given one."""


def _thing(name: str) -> _Thing:
    thing = _Thing()
    thing.name = name  # pyright: ignore[reportAttributeAccessIssue] - one that its class does not know
    return thing


@pytest.mark.parametrize(
    ("hint", "right", "wrong"),
    [
        (Float[np.ndarray, "n 3"], np.ones((2, 3)), np.ones((2, 4))),
        (Float[np.ndarray, "n 3"], np.ones((2, 3)), np.ones((2, 3), int)),
        (Float[np.ndarray, "n 3"], np.ones((2, 3)), np.ones((2, 3, 1))),
        (tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]], (np.ones(2),) * 2, (np.ones(2), np.ones(3))),
        (tuple[int, ...], (1, 1), ("1", "1")),
        (tuple[int, ...], _Pair(1, 1), _Pair("1", "1")),
        (list[int] | None, [1], ["1"]),
        (Sequence[int], [1], ["1"]),
        (Mapping[str, int], {"1": 1}, {"1": "1"}),
        (Literal["1"] | None, "1", "2"),
        (runtime_checkable(_Named), _thing("1"), _Thing()),
        (int, 1, "1"),
    ],
)
def test_what_passed_lets_nothing_pass_that_is_unlike_it(hint: Any, right: Any, wrong: Any) -> None:
    """Of an argument and of a result: a call like one before is not looked at again."""

    def same(x: Any) -> None:
        return None

    def other(x: Any) -> Any:
        return x

    same.__annotations__["x"] = other.__annotations__["return"] = hint
    for function in (same, other):
        looked_at = shape_checks.checked(typechecker=None)(function)
        looked_at(right)
        looked_at(right)
        with pytest.raises(TypeCheckError):
            looked_at(wrong)
        looked_at(right)


def test_a_result_is_looked_at_beside_the_arguments_that_it_came_from() -> None:
    """Also where both are of kinds that passed, but not together."""
    results = [np.ones(2), np.ones(3), np.ones(3)]

    def given(x: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return results.pop(0)

    looked_at = shape_checks.checked(typechecker=None)(given)
    looked_at(np.ones(2))
    looked_at(np.ones(3))
    with pytest.raises(TypeCheckError):
        looked_at(np.ones(2))


def test_an_argument_is_looked_at_by_its_own_name() -> None:
    def of(count: int = 0, name: str = "") -> None:
        return None

    looked_at = shape_checks.checked(typechecker=None)(of)
    looked_at(count=1)
    looked_at(name="1")
    with pytest.raises(TypeCheckError):
        looked_at(name=1)
    with pytest.raises(TypeCheckError):
        looked_at(count="1")


def test_a_function_that_is_made_at_every_call_is_looked_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    made, with_hints = [], shape_checks._with_hints
    monkeypatch.setattr(shape_checks, "_with_hints", lambda *what: made.append(what) or with_hints(*what))

    def times(factor: int, hint: Any) -> Any:
        def product(value: Any) -> Any:
            return factor * value

        product.__annotations__ = {"value": hint, "return": hint}
        return shape_checks.checked(typechecker=None)(product)

    assert [times(factor, float)(2.0) for factor in (1, 2, 3)] == [2.0, 4.0, 6.0]
    assert len(made) == 1
    for factor in (1, 2, 3):
        assert times(factor, Float[np.ndarray, " n"])(np.ones(2)).sum() == 2 * factor
    assert len(made) == 2
    assert times(2, int)(2) == 4
    for hint, wrong in ((float, "a"), (int, 2.0), (Float[np.ndarray, "n n"], np.ones(2))):
        with pytest.raises(TypeCheckError):
            times(2, hint)(wrong)  # what passed another hint, or none
