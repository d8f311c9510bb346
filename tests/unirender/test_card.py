"""The model card: what it says stands in the facts, and what the facts lack is not in it."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from synthetic_shards import write_dataset
from tiny_models import TRAIN

from unirender.pipelines.unirender_pipeline import UniRenderPipeline
from unirender.score import Score
from unirender.shipped import checkpoint_folder, checkpoint_sha256, shipped_names
from unirender.training.config import RunConfig
from unirender.training.data.source import ShardSource
from unirender.training.loop.card import CARD_FILE, card_text
from unirender.training.loop.export import export_pipeline
from unirender.training.loop.trainer import Trainer

FACTS: dict[str, Any] = {
    "preset": "tiny",
    "parameters": 1234567,
    "steps": 4000,
    "samples": 96000,
    "minutes": 61.5,
    "device": "cpu",
    "autocast": "bfloat16",
    "hardware": {"processor": "Some CPU", "threads": 2, "processes": 1},
    "software": {"unirender": "9.9.9", "torch": "8.8"},
    "data": {"folder": "shards", "fingerprint": "abc123", "shards": 3, "groups": 40, "pairs": 720},
    "losses": {"step": 4000, "minutes": 61.5, "samples_per_s": 25.0, "albedo": 0.0125, "lr": 1e-5, "grad_norm": 0.5},
    "scores": {"albedo.psnr": 19.25},
    "scored_on": "4 scenes of the suite tiny",
    "train": {"model": {"resolution": 64, "codec": "pixel"}, "batch_size": 24},
    "continues": [
        {
            "preset": "tiny_plain",
            "steps": 10,
            "samples": 240,
            "minutes": 0.5,
            "train": {"model": {"resolution": 32}},
        }
    ],
    "stored_as": "float16",
}
CHOSEN: dict[str, Any] = {
    "step": 4000,
    "chosen_by": "albedo.psnr",
    "scores": {"albedo.psnr": {"value": 21.0, "higher_is_better": True}},
}
SAID = {
    "preset": "| preset | `tiny` |",
    "parameters": "| parameters | 1,234,567 |",
    "steps": "| steps | 4,000 |",
    "samples": "| samples | 96,000 |",
    "minutes": "| minutes | 61.5 |",
    "hardware": "Some CPU, cpu, 2 threads, autocast bfloat16",
    "software": "| software | unirender 9.9.9, torch 8.8 |",
    "data": "`shards`: 3 shards, 40 groups, 720 pairs; fingerprint `abc123`",
    "losses": "| albedo | 0.0125 |",
    "scores": "| albedo.psnr | 19.25 |",
    "scored_on": "Measured on 4 scenes of the suite tiny",
    "train": "| model | resolution 64, codec pixel |",
    "continues": "| 1 | `tiny_plain`, 10 steps, 240 samples, 0.5 minutes, 32 x 32 pixels |",
    "stored_as": "| weights stored as | float16 |",
}


def front_matter(card: str) -> dict[str, Any]:
    assert card.startswith("---\n")
    return yaml.safe_load(card.split("---\n")[1])


@pytest.mark.parametrize("missing", [None, *SAID])
def test_every_fact_has_its_line_and_a_missing_fact_has_none(missing: str | None) -> None:
    card = card_text("pipeline", {name: value for name, value in FACTS.items() if name != missing})
    unsaid = {missing, "scored_on"} if missing == "scores" else {missing}
    for name, line in SAID.items():
        assert (line in card) == (name not in unsaid), name
    assert "None" not in card
    assert "grad_norm" not in card
    assert "flatter" not in card
    assert 'from_pretrained("pipeline")' in card


def test_the_title_is_the_name_where_it_says_more_than_that_of_every_run() -> None:
    assert "# unirender: tiny\n" in card_text("pipeline", FACTS)
    assert "# unirender: mine\n" in card_text("mine", FACTS)
    assert "# unirender\n" in card_text("best", {})


def test_chosen_weights_say_that_their_scores_flatter_them() -> None:
    card = card_text("best", FACTS, CHOSEN)
    assert "chosen by albedo.psnr on these very scenes: its scores there flatter it" in card
    assert "| albedo.psnr | 21 |" in card
    assert "19.25" not in card


def test_the_front_matter_is_that_of_a_model_card() -> None:
    head = front_matter(card_text("pipeline", FACTS))
    assert (head["library_name"], head["license"]) == ("diffusers", "apache-2.0")
    assert "inverse-rendering" in head["tags"]
    foreign = card_text("pipeline", FACTS | {"train": {"model": {"resolution": 512, "codec": "kl"}}})
    assert "license" not in front_matter(foreign)  # the autoencoder's is not ours to state
    assert "Stable Diffusion's autoencoder" in foreign


def test_a_record_of_an_older_version_gives_a_shorter_card() -> None:
    newer = json.loads((checkpoint_folder() / "training.json").read_text())
    older = {"steps", "samples", "minutes", "device", "autocast", "train", "continues"}
    facts = {name: value for name, value in newer.items() if name in older}
    facts["continues"] = [{name: run[name] for name in older & run.keys()} for run in newer["continues"]]
    card = card_text("tiny", facts)
    assert f"| samples | {facts['samples']:,} |" in card
    assert card.count(" samples, ") == len(facts["continues"])
    assert "fingerprint" not in card
    assert "averaged" not in card
    averaged = newer | {"averaged": {"this run": 0.75, "the run before": 0.25}}
    assert "0.75 of this run, 0.25 of the run before" in card_text("tiny", averaged)


@pytest.mark.parametrize("name", shipped_names())
def test_every_shipped_checkpoint_has_the_card_of_its_facts(name: str) -> None:
    folder = checkpoint_folder(name)
    assert (folder / CARD_FILE).read_text() == card_text(name, json.loads((folder / "training.json").read_text()))


def test_every_exported_pipeline_has_its_card(tmp_path: Path) -> None:
    data = write_dataset(tmp_path / "data", size=32)
    config = dataclasses.replace(TRAIN, batch_size=2)
    run = RunConfig(tmp_path / "run", steps=2, log_every=1, keep_best="error", preset="tiny", scored_on="4 scenes")
    trainer = Trainer(config, run, torch.device("cpu"), torch.float32)
    source = ShardSource(data, config.batch_size, config.seed)
    source.open()
    scores = iter([3.0, 5.0])

    def validate(pipeline: UniRenderPipeline) -> dict[str, Score]:
        return {"error": Score(next(scores), higher_is_better=False)}

    trainer.fit(source, validate=validate)
    folder = export_pipeline(trainer, tmp_path / "run" / "pipeline")
    assert len({file.stat().st_mode for file in folder.rglob("*.*") if file.is_file()}) == 1, "the umask's"
    assert source.dataset is not None
    groups, fingerprint = len(source.dataset), source.dataset.fingerprint
    source.close()
    cards = {name: (tmp_path / "run" / name / CARD_FILE).read_text() for name in ("pipeline", "best")}
    for name, card in cards.items():
        facts = json.loads((tmp_path / "run" / name / "training.json").read_text())
        assert facts["data"]["fingerprint"] == fingerprint
        assert f"{groups} groups" in card
        assert f"| parameters | {sum(p.numel() for p in trainer.model.parameters()):,} |" in card
        assert "Measured on 4 scenes, with" in card
        assert str(tmp_path) not in card + json.dumps(facts)  # folders travel
        assert front_matter(card)["library_name"] == "diffusers"
    assert "| steps | 2 |" in cards["pipeline"]
    assert "| error | 5 |" in cards["pipeline"]
    assert "mean up to step 2" in cards["pipeline"]
    assert "| steps | 0 |" in cards["best"]  # before the first step it was better
    assert "| error | 3 |" in cards["best"]
    assert "chosen by error" in cards["best"]
    assert "Loss at the end" not in cards["best"]
    before = checkpoint_sha256(folder)
    (folder / CARD_FILE).write_text("another text")
    (folder / "training.json").write_text("{}")
    assert checkpoint_sha256(folder) == before
    (folder / "model_index.json").write_text("{}")
    assert checkpoint_sha256(folder) != before  # the twin
