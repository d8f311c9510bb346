"""The Python blocks of `docs/optimization.md`, run from top to bottom as a reader would, with less of everything."""

import re
from pathlib import Path

import numpy as np
import pytest

from unirender_reference.optimize.views import Views

DOCS = Path(__file__).resolve().parents[3] / "docs"
INCLUDE = re.compile(r"^```\{include\} (\S+)\n```$", re.MULTILINE)
BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SMALL = """OptimizeConfig(
    transport=TransportConfig(pixels=300, fine_below=0.0, iterations=1, rounds=0),
    refine=RefineConfig(iterations=2, spp=4, spp_gradient=4, depth=2),
    texture_size=16,
    light_rows=8,
)"""
LESS = {
    "resolution=64": "resolution=24",
    "orbit(9, camera)": "orbit(3, camera)",
    "spp=64": "spp=16",
    "OptimizeConfig()": SMALL,
    "place=place)": "place=place, pictures=False, threads=1)",
    "SingleConfig()": "SingleConfig(coarse_pixels=150, pixels=300, steps=(1, 1, 1), fine_steps=1, light_rows=8)",
}
IMPORTS = """
from unirender_reference.optimize.refine_config import RefineConfig
from unirender_reference.optimize.transport_config import TransportConfig
"""


def blocks(page: Path) -> list[str]:
    """The Python blocks of a page, those of the pages that it includes in their places."""
    text = INCLUDE.sub(lambda match: (page.parent / match[1]).read_text(encoding="utf-8"), page.read_text("utf-8"))
    return BLOCK.findall(text)


def shortened(block: str) -> str:
    for words, less in LESS.items():
        block = block.replace(words, less)
    return block


@pytest.mark.slow
def test_the_examples_run_from_top_to_bottom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    shown = blocks(DOCS / "optimization.md")
    assert not [words for words in LESS if not any(words in block for block in shown)]
    names: dict = {}
    exec(IMPORTS, names)
    for block in shown:
        exec(shortened(block), names)
    views, found, image = names["views"], names["found"], names["image"]
    assert isinstance(views, Views)
    assert (len(views.seen), len(views.held_out)) == (2, 1)
    assert (tmp_path / "found/solution.json").is_file()
    assert found.albedo.shape == (24, 24, 3)
    assert np.asarray(image)[..., 3].max() > 0.9


def test_a_block_that_does_not_run_is_found(tmp_path: Path) -> None:
    """The twin: blocks of included pages are seen, in their places, and what they miss is an error."""
    (tmp_path / "part.md").write_text("```python\nviews\n```\n")
    (tmp_path / "page.md").write_text("```python\na = 1\n```\n\n```{include} part.md\n```\n\n```python\nb = 2\n```\n")
    found = blocks(tmp_path / "page.md")
    assert found == ["a = 1\n", "views\n", "b = 2\n"]
    with pytest.raises(NameError, match="views"):
        exec(found[1], {})
