"""Tables: published beside measured, ranks on rounded values, n/a, watermark, and the formats."""

import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from io import StringIO
from typing import Any

import pytest
from markdown_it import MarkdownIt
from rich.console import Console

from unirender.errors import UnirenderError
from unirender_evaluation.comparisons import Selection, compare, verdicts
from unirender_evaluation.metrics import ALL_VARIANTS, METRICS, Variant, chosen_variants, metric_key
from unirender_evaluation.records import MethodInfo, Record, RunInfo
from unirender_evaluation.statistics import UNPRINTED
from unirender_evaluation.tables.build import Cell, Row, Table, build_table, build_tables
from unirender_evaluation.tables.formats import format_number, print_table, print_tables, to_json, to_markdown
from unirender_evaluation.tables.latex import tex_text, to_latex
from unirender_evaluation.tables.notes import NAMED
from unirender_evaluation.tables.protocol import mask_source
from unirender_evaluation.tables.published import check_name, published_tables
from unirender_evaluation.tables.specs import TABLES, Column, TableSpec
from unirender_evaluation.tables.text import TextTable, markdown_row, plain_paragraph

METHODS = (
    MethodInfo("ours", "Ours (mean)", "ours", "Ours", 1, 1, 0),
    MethodInfo("sample", "Ours (sample)", "ours", None, 20, 5, 0, mask="own"),
    MethodInfo("constant", "Constant 0.5", "trivial"),
    MethodInfo("input", "Input as albedo", "trivial"),
    MethodInfo("ceiling", "Noise ceiling", "ceiling"),
)
RUN = RunInfo("tiny", "abcdef0123456789", 64, METHODS, coverage=0.34, lpips=("alex",), mitsuba="3.9.1", truth_spp=2048)
LEVEL = {"ours": 21.0, "sample": 20.0, "input": 12.0, "ceiling": 45.0}
WHOLE = Variant("whole")
NO_BREAK = "\N{NO-BREAK SPACE}"
MATERIAL = {"ours": 0.06, "sample": 0.07, "constant": 0.1, "ceiling": 0.0}


def inverse(method: str, n: int = 8) -> list[Record]:
    records = []
    for i in range(n):
        values: dict[str, float] = {}
        for mask in ("masked", "whole"):
            variant = Variant(mask)
            if method in LEVEL:
                db = LEVEL[method] + 0.1 * (i % 4) + (5 if mask == "whole" else 0)
                values[metric_key("albedo", "psnr", variant)] = db
                values[metric_key("albedo", "lpips_alex", variant)] = 1 / db
            if method in MATERIAL:
                values[metric_key("metallic", "mse", variant)] = MATERIAL[method]
        records.append(Record("inverse", "single-image", method, f"s{i}", f"o{i // 2}", values))
    return records


RECORDS = [record for key in ("ours", "constant", "input", "ceiling") for record in inverse(key)] + inverse("sample", 4)


def table(mask: str = "whole", run: RunInfo = RUN) -> Table:
    return build_table(TABLES["inverse"], RECORDS, run, protocol="single-image", variant=Variant.parse(mask))


def spaced(found: Table) -> str:
    """Its Markdown, with spaces that may break in place of those that may not."""
    return to_markdown(found).replace(NO_BREAK, " ")


def printed(found: Table, width: int = 200) -> str:
    """What a terminal shows."""
    buffer = StringIO()
    print_table(Console(file=buffer, width=width), found)
    return buffer.getvalue()


def row(found: Table, label: str) -> Row:
    return next(r for r in found.rows if r.label.startswith(label))


def test_published_numbers_are_the_papers() -> None:
    """Spot checks against the paper's tables, one value in each corner."""
    tables = {name: {r.name: r.values for r in rows} for name, rows in published_tables().items()}
    assert [len(rows) for rows in tables.values()] == [5, 11, 5]
    assert tables["rendering"]["InPix2Pix*"]["edit_metallic.psnr"] == 24.25
    assert tables["rendering"]["Ours w/o re-render"]["edit_roughness.lpips_vgg"] == 0.0833
    assert tables["inverse"]["Yi et al."] == {"albedo.psnr": 20.93, "albedo.ssim": 0.896, "albedo.lpips_vgg": 0.1024}
    assert tables["inverse"]["Ours w/o constrain"]["normal.cosine"] == 0.922
    assert tables["relighting"]["NvDiffrec"]["specular.psnr"] == 14.12
    assert tables["relighting"]["Ours w/o constrain"]["relit.lpips_vgg"] == 0.0924


def test_every_published_value_has_a_column() -> None:
    for name, rows in published_tables().items():
        columns = {column.published_key for column in TABLES[name].columns if column.published}
        assert {key for entry in rows for key in entry.values} == columns


def test_the_ablation_answers_to_both_of_its_names() -> None:
    for rows in published_tables().values():
        assert sum(entry.is_called("Ours w/o constrain") for entry in rows) == 1
    check_name("Ours w/o re-render")
    with pytest.raises(UnirenderError, match="expected one of"):
        check_name("Theirs")


def test_measured_stands_beside_published_in_the_papers_order() -> None:
    found = table()
    labels = [r.label for r in found.rows]
    assert labels[:2] == ["Yi et al.", "IntrinsicAnything"]
    assert labels.index("Ours (mean) [Uni-Renderer]") == labels.index("GaussianShader") + 1
    assert labels[-4:] == ["Ours (sample)", "Constant 0.5", "Input as albedo", "Noise ceiling"]
    cell = row(found, "Ours (mean)").cells[0]
    assert cell.published == 23.20
    assert cell.measured is not None
    assert (cell.measured.mean, cell.measured.n, cell.measured.clusters) == (pytest.approx(26.15), 8, 4)


def test_published_values_never_stand_beside_another_protocol_or_mask() -> None:
    assert not any(table("masked").published_columns)
    given = [replace(record, table="rendering", protocol="given") for record in RECORDS]
    for found in build_tables(given, RUN):
        assert found.variant.mask == "masked"
        assert all(r.info is not None for r in found.rows)


def test_materials_are_taken_in_the_mask_in_every_variant() -> None:
    masked, whole = (row(table(mask), "Ours (mean)") for mask in ("masked", "whole"))
    index = [column.group for column in TABLES["inverse"].columns].index("Metallic")
    assert masked.cells[-1].measured == whole.cells[index].measured


def test_ranks_are_on_rounded_values_and_leave_bounds_and_subsets_out() -> None:
    found = table("masked")
    ranks = {r.label: r.cells[0].measured_rank for r in found.rows}
    assert ranks == {
        "Ours (mean)": 1, "Ours (sample)": None, "Constant 0.5": None, "Input as albedo": 2, "Noise ceiling": None
    }  # fmt: skip
    close = [replace(r, values={k: v - 1e-4 for k, v in r.values.items()}, method="input") for r in inverse("ours")]
    tied = build_table(TABLES["inverse"], inverse("ours") + close, RUN, protocol="single-image")
    assert [r.cells[0].measured_rank for r in tied.rows] == [1, 1]


def counted(albedo: Mapping[str, int], metallic: Mapping[str, int]) -> Table:
    """The masked inverse table of rows that answer so many samples of albedo, and so many of metallic."""
    records = []
    for method in dict.fromkeys([*albedo, *metallic]):
        for i in range(max(albedo.get(method, 0), metallic.get(method, 0))):
            values = {metric_key("albedo", "psnr"): 30.0} if i < albedo.get(method, 0) else {}
            values |= {metric_key("metallic", "mse"): 0.1} if i < metallic.get(method, 0) else {}
            records.append(Record("inverse", "single-image", method, f"s{i}", f"o{i // 2}", values))
    run = replace(RUN, methods=tuple(MethodInfo(key, key, "external") for key in ("a", "b", "c")))
    return build_table(TABLES["inverse"], records, run, protocol="single-image")


def labels(found: Table) -> list[str]:
    """The rows' labels as printed, without those of the paper."""
    return [line.split(" | ")[0][2:] for line in spaced(found).splitlines() if re.match(r"\| (a|b)\b", line)]


def fewer(found: Table) -> str:
    """Which rows the note names."""
    return next((n.partition("ranked: ")[2] for n in found.notes if n.startswith("Measured on fewer")), "")


def test_a_cell_on_fewer_samples_than_its_columns_fullest_says_so_and_is_not_ranked() -> None:
    found = counted({"a": 8, "b": 8, "c": 2}, {"a": 8, "b": 8, "c": 8})
    albedo = [column.metric.name for column in found.columns].index("psnr")
    metallic = [column.group for column in found.columns].index("Metallic")
    assert [r.cells[albedo].measured_rank for r in found.rows] == [1, 1, None]
    assert [r.cells[metallic].measured_rank for r in found.rows] == [1, 1, 1]
    assert fewer(found) == "c (Albedo n = 2)."
    for text in (spaced(found), to_latex(found), printed(found).partition("Protocol")[0]):
        (line,) = (line for line in text.splitlines() if re.match(r"(\| )? ?c ", line))
        assert line.count("(n = 2)") == 1
        assert text.count("n = 2") == 1 + (text.count("Albedo n = 2"))


@pytest.mark.parametrize(("table", "protocol", "quantity"), [
    ("inverse", "single-image", "albedo"), ("relighting", "from-image-hdri", "relit")
])  # fmt: skip
@pytest.mark.parametrize(("level", "ranks"), [(60.0, [1, None, 2]), (45.0, [2, 1, None])])
def test_a_row_that_knows_the_truth_is_not_ranked(
    table: str, protocol: str, quantity: str, level: float, ranks: list[int | None]
) -> None:
    """Its maps are the truth but for rounding, or its pictures exceed the noise ceiling."""
    key, methods = metric_key(quantity, "psnr"), {"good": 30.0, "told": level, "bad": 20.0}
    gains = {f"{quantity}.if_shifted": -20.0}  # as a stranger's records have them
    records = [
        Record(table, protocol, method, f"s{i}", f"o{i}", {key: db + 0.1 * (i % 2), **gains})
        for method, db in (methods | ({"noise-ceiling": 53.0} if quantity == "relit" else {})).items()
        for i in range(12)
    ]
    kinds: dict[str, Any] = {"noise-ceiling": "ceiling"}
    run = replace(RUN, methods=tuple(MethodInfo(m, m, kinds.get(m, "external")) for m in (*methods, "noise-ceiling")))
    found = build_table(TABLES[table], records, run, protocol=protocol)
    place = [column.key(found.variant) for column in found.columns].index(key)
    by_label = {r.label: r.cells[place].measured_rank for r in found.rows}
    assert [by_label[method] for method in methods] == ranks
    assert any(note.startswith("Not ranked") and note.endswith(": told.") for note in found.notes) == (level > 50)


def test_a_row_that_answers_one_question_in_full_is_complete() -> None:
    found = counted({"a": 8, "b": 8}, {"a": 4, "b": 4, "c": 4})
    assert fewer(found) == ""
    assert [row(found, "c").cells[i].measured_rank for i, c in enumerate(found.columns) if c.group == "Metallic"] == [1]
    assert "(n =" not in spaced(found)


def test_the_n_behind_a_label_is_that_of_no_other_cell() -> None:
    found = counted({"a": 8, "b": 4}, {"a": 4, "b": 1})
    assert labels(found) == ["a", "b (n = 4)"]
    assert spaced(found).count("(n = 1)") == 1
    assert fewer(found) == "b (n = 4, Metallic n = 1)."
    assert labels(counted({"a": 8, "b": 4}, {"a": 4, "b": 4})) == ["a", "b (n = 4)"]  # of all of its cells
    mixed = counted({"a": 8, "b": 5}, {"a": 4, "b": 4})  # complete in metallic, where n is 4
    assert labels(mixed) == ["a", "b"]
    assert fewer(mixed) == "b (Albedo n = 5)."


def test_a_cell_on_the_same_share_of_its_column_has_its_own_n() -> None:
    """As where a row ran on half of the scenes, and metallic is asked half as often; a full row has none."""
    found = counted({"a": 8, "b": 4}, {"a": 4, "b": 2})
    assert labels(found) == ["a", "b (n = 4)"]
    assert fewer(found) == "b (n = 4, Metallic n = 2)."
    for text in (spaced(found), to_latex(found), printed(found).partition("Protocol")[0]):
        (full,) = (line for line in text.splitlines() if re.match(r"(\| )? ?a ", line))
        (half,) = (line for line in text.splitlines() if re.match(r"(\| )? ?b ", line))
        assert "n =" not in full
        assert (half.count("(n = 4)"), half.count("(n = 2)")) == (1, 1)


def test_a_published_value_worse_than_a_constant_has_a_dagger() -> None:
    index = [column.group for column in TABLES["inverse"].columns].index("Metallic")
    daggers = {r.label: r.cells[index].dagger for r in table().rows if r.cells[index].published is not None}
    assert daggers == dict.fromkeys(daggers, True)  # 0.100 beats every published row
    assert "**0.1182**†" in to_markdown(table())
    assert [note for note in table().notes if note.startswith("† The published value is worse than")]
    assert not [note for note in table("masked").notes if note.startswith("†")]
    without = [record for record in RECORDS if record.method != "constant"]
    assert "†" not in to_markdown(build_table(TABLES["inverse"], without, RUN, protocol="single-image"))


def test_an_absent_backbone_is_not_available_and_an_absent_value_is_a_dash() -> None:
    text = to_markdown(table("masked"))
    ours = next(line for line in text.splitlines() if line.startswith("| Ours (mean)"))
    constant = next(line for line in text.splitlines() if line.startswith("| Constant"))
    assert "n/a" in ours
    assert "n/a" not in constant
    assert "are not on this machine" in text


def test_absurd_numbers_take_no_more_room_than_others() -> None:
    shown = [format_number(value, 2) for value in (999999.0, 1.5e6, -3e45, math.inf)]
    assert shown == ["999999.00", "1.50e+06", "-3.00e+45", "∞"]


def test_a_limited_run_is_watermarked_in_every_format() -> None:
    found = table(run=replace(RUN, limit=3))
    for text in (to_markdown(found), to_latex(found), to_json([found]), printed(found, 100)):
        assert re.search(r"-?-limit 3: a partial run, not a result", text)
    assert "partial run" not in to_markdown(table())


def test_a_stored_row_says_so() -> None:
    stored = replace(RUN, methods=(replace(METHODS[0], stored="2026-11-21, suite abc"), *METHODS[1:]))
    text = to_markdown(table(run=stored))
    assert "(stored)" in text
    assert "not measured in this run (2026-11-21, suite abc)" in text


def test_the_protocol_is_printed_with_every_format() -> None:
    found = table()
    names = [name for name, _ in found.protocol]
    assert names[:6] == ["given", "variant", "mask", "colour", "scale alignment", "exposure"]
    assert dict(found.protocol)["steps x samples"] == "Ours (mean) 1 x 1; Ours (sample) 20 x 5"
    assert {"resolution", "n", "coverage", "steps x samples", "seeds", "LPIPS", "interval", "suite", "truth"} <= set(
        names
    )
    for text in (to_markdown(found), " ".join(printed(found, 90).split())):
        assert "resolution: 64 x 64" in text
        assert "own mask: Ours (sample)" in text
        assert "8 samples of 4 objects" in text
    assert "published" not in [name for name, _ in table("masked").protocol]
    lpips = [dict(table(mask, replace(RUN, lpips=("vgg",))).protocol)["LPIPS"] for mask in ("masked", "whole")]
    assert ["over the whole frame" in text for text in lpips] == [True, False]  # it has no map to weight by coverage


def test_the_protocol_names_lpips_only_where_a_column_has_it() -> None:
    inverse_table = TABLES["inverse"]
    materials = tuple(column for column in inverse_table.columns if column.metric.name == "mse")
    without = build_table(replace(inverse_table, columns=materials), RECORDS, RUN, protocol="single-image")
    assert "LPIPS" not in dict(without.protocol)
    assert "LPIPS" in dict(table("masked").protocol)


def test_what_published_values_are_of_is_said_where_they_stand() -> None:
    """Another test set, what the paper leaves open of this table, and that the row beside them is no run of theirs."""
    said = dict(table().protocol)["published"]
    for text in (
        "of systems and on data that are not those of this table",
        "Objaverse",
        "materials of the test objects",
    ):
        assert text in said
    assert "how s and d of the target were made" not in said  # another table's
    assert NAMED in table().notes
    assert NAMED not in table("masked").notes


def test_the_protocol_says_which_records_earlier_code_measured() -> None:
    run = replace(RUN, code="abc", date="2026-07-20")
    assert dict(table(run=run).protocol)["code"] == "abc, 2026-07-20"
    carried = table(run=replace(run, carried="records of July"))
    assert dict(carried.protocol)["code"] == "abc, 2026-07-20 (records of July)"


def test_the_protocol_says_whose_mask() -> None:
    """Maps have a mask of their own, pictures do not; without an own mask nothing is claimed."""
    relit = [replace(r, table="relighting", protocol="from-image-sd") for r in inverse("sample")]
    pictures = [replace(r, values={"relit.psnr@whole-srgb-raw": 20.0}) for r in relit]
    build = partial(build_table, TABLES["relighting"], run=RUN, protocol="from-image-sd", variant=Variant("whole"))
    assert "own mask: Ours (sample) (maps;" in dict(build(records=relit).protocol)["mask"]
    assert "the true mask pasted on every row" in dict(build(records=pictures).protocol)["mask"]
    own = replace(relit[0], method="ours", values={"mask.iou": 0.9})
    assert [mask_source(key, [*relit, own]) for key in ("ours", "sample")] == ["own", "pasted"]


def test_every_variant_has_a_table_with_its_own_numbers() -> None:
    levels = {variant: 20.0 + i for i, variant in enumerate(ALL_VARIANTS)}
    values = {metric_key("albedo", "psnr", variant): level for variant, level in levels.items()}
    values |= {metric_key("albedo", "lpips_alex", Variant(mask)): 0.1 for mask in ("masked", "whole")}
    records = [Record("inverse", "single-image", "ours", f"s{i}", f"o{i}", values) for i in range(2)]
    found = build_tables(records, RUN, variants=chosen_variants(["all"]))
    assert [table.variant for table in found] == list(ALL_VARIANTS)
    for table in found:
        (ours,) = [row for row in table.rows if row.key == "ours"]
        assert ours.cells[0].measured is not None
        assert ours.cells[0].measured.mean == levels[table.variant]
        assert dict(table.protocol)["variant"] == table.variant.label
        assert any(table.published_columns) == (table.variant == Variant("whole"))
    assert (
        len({table.heading for table in found})
        == len({to_latex(t).split("label{")[1].split("}")[0] for t in found})
        == len(found)
    )


def test_lpips_of_aligned_pictures_is_a_dash_and_the_protocol_says_why() -> None:
    values = {metric_key("albedo", "psnr", Variant(scale=scale)): 20.0 for scale in ("raw", "aligned")}
    values[metric_key("albedo", "lpips_alex")] = 0.1
    records = [Record("inverse", "single-image", "ours", f"s{i}", f"o{i}", values) for i in range(2)]
    raw, aligned = build_tables(records, RUN, variants=chosen_variants(["masked", "masked-aligned"]) or ())
    vgg, alex = ([column.metric.name for column in raw.columns].index(name) for name in ("lpips_vgg", "lpips_alex"))
    assert raw.rows[0].cells[vgg].unavailable
    assert raw.rows[0].cells[alex].measured is not None
    assert aligned.rows[0].cells[vgg] == aligned.rows[0].cells[alex] == Cell()
    assert "not computed of aligned pictures" in dict(aligned.protocol)["LPIPS"]
    assert "not computed" not in dict(raw.protocol)["LPIPS"]
    assert "n/a:" not in to_markdown(aligned)


def test_variants_that_a_table_cannot_tell_apart_are_one_table() -> None:
    column = Column("Material", "metallic", METRICS["mse"], published=False)
    spec = TableSpec("physics", "Physics", (column,), ("physics",))
    values = {"metallic.mse@masked": 0.1, "metallic.mse@whole": 0.05}
    records = [Record("physics", "physics", "ours", "s", "o", values)]
    found = build_tables(records, RUN, {"physics": spec}, ALL_VARIANTS)
    assert [table.variant for table in found] == [Variant("masked"), Variant("whole")]
    assert [table.variant for table in build_tables(records, RUN, {"physics": spec})] == [Variant("masked")]


def test_markdown_is_a_table() -> None:
    lines = [line for line in spaced(table()).splitlines() if line.startswith("|")]
    assert len(lines) == 2 + len(table().rows)
    assert len({line.count("|") for line in lines}) == 1
    assert "| **23.20** | **26.15** ± 0.18 |" in next(line for line in lines if line.startswith("| Ours (mean)"))


def test_latex_has_units_minus_signs_and_rows_that_are_no_options() -> None:
    """A row of `[x]` or `*x` would be the length, or the star, of the line break before it."""
    column = Column("Light", "light", replace(METRICS["psnr"], name="loss", label="loss"), published=False)
    spec = TableSpec(
        "inverse", "Light", (column, Column("Light", "light", METRICS["psnr"], published=False)), ("single-image",)
    )
    run = replace(RUN, methods=(MethodInfo("a", "[x]", "external"), MethodInfo("b", "*x", "external")))
    keys = [c.key(Variant()) for c in spec.columns]
    records = [Record("inverse", "single-image", m, "s", "o", dict.fromkeys(keys, -1.5)) for m in "ab"]
    text = to_latex(build_table(spec, records, run, protocol="single-image"))
    assert r"Method & loss (dB)$\uparrow$ & PSNR$\uparrow$" in text
    assert r"{}[x] & \textbf{$-$1.50} & \textbf{$-$1.50}" in text
    assert r"{}*x & \textbf{$-$1.50}" in text


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("-0.5 dB [-1, +2]", "$-$0.5 dB [$-$1, +2]"),
        ("1e-05 and -∞", r"1e$-$05 and $-$$\infty$"),
        ("GPT-4, 2026-11-30, --limit 2", "GPT-4, 2026-11-30, -{}-limit 2"),
        ("a_b & 5% #1 ${x}", r"a\_b \& 5\% \#1 \$\{x\}"),
        ("two\n\nlines", "two lines"),
    ],
)
def test_latex_shows_a_text_as_it_is(text: str, shown: str) -> None:
    """A minus sign is none within a name or a date, and an empty line would end the caption."""
    assert tex_text(text) == shown


def test_a_row_without_a_value_in_any_column_is_left_out() -> None:
    """Wonder3D is published with normals alone, and nobody answered for the others."""
    whole = TABLES["inverse"]
    narrow = replace(whole, columns=tuple(column for column in whole.columns if column.metric.name == "psnr"))
    labels = {
        len(spec.columns): {
            r.label for r in build_table(spec, RECORDS, RUN, protocol="single-image", variant=WHOLE).rows
        }
        for spec in (whole, narrow)
    }
    assert labels[len(whole.columns)] - labels[1] == {"Wonder3D", "Constant 0.5"}


def test_in_a_narrow_cell_what_belongs_together_stays_on_a_line() -> None:
    texts = ["Ours (n = 48)", "**26.5** ± 1.2 (n = 24)", "+5.3 [+4.6, -6.0]", "a ± b [c, d]"]
    made = [
        f"Ours (n{NO_BREAK}={NO_BREAK}48)",
        f"**26.5** ±{NO_BREAK}1.2 (n{NO_BREAK}={NO_BREAK}24)",
        f"+5.3 [+4.6,{NO_BREAK}-6.0]",
        texts[-1],
    ]
    assert markdown_row(texts) == f"| {' | '.join(made)} |"


def test_means_of_two_objects_have_no_interval_in_any_format() -> None:
    records = [record for record in RECORDS if record.object in ("o0", "o1")]
    of_two = build_table(TABLES["inverse"], records, RUN, protocol="single-image", variant=Variant("masked"))
    for text in (to_markdown(of_two), to_latex(of_two), printed(of_two)):
        assert "21.15" in text
        assert "±" not in text.replace(UNPRINTED, "")
        assert "pm$" not in text.replace(r"no $\pm$", "")
    assert UNPRINTED in of_two.notes
    complete = build_table(TABLES["inverse"], inverse("ours"), RUN, protocol="single-image")
    assert UNPRINTED not in complete.notes
    (found,) = json.loads(to_json([of_two]))
    ours = next(row for row in found["rows"] if row["key"] == "ours")
    assert ours["cells"][0]["measured"]["low"] is None


def test_latex_is_balanced_booktabs() -> None:
    text = to_latex(table())
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")]
    (spec,) = re.findall(r"\\begin\{tabular\}\{l(c+)\}", text)
    rows = [line for line in body[body.index(r"\midrule") :].splitlines() if line.endswith(r"\\")]
    assert len(rows) == len(table().rows)
    assert all(len(re.findall(r"(?<!\\)&", line)) == len(spec) for line in rows)
    assert text.count("{") == text.count("}")
    assert r"\textbf{26.15} {\scriptsize $\pm$" in text
    assert not re.search(r"[±†·∞↑↓]", text)


def test_latex_has_the_best_in_bold_and_the_second_underlined() -> None:
    lines = [line.split(" & ") for line in to_latex(table("masked")).splitlines() if " & " in line]
    albedo = {label.strip(): cell for label, cell, *_ in lines}
    starts = {"Ours (mean)": r"\textbf{21.15}", "Input as albedo": r"\underline{12.15}", "Noise ceiling": "45.15"}
    assert {label: albedo[label].split(" {")[0] for label in starts} == starts


def named(label: str, note: str = "") -> Table:
    """The masked inverse table of one stranger's row."""
    records = [replace(record, method="theirs") for record in inverse("ours")]
    run = replace(RUN, methods=(MethodInfo("theirs", label, "external", note=note),))
    return build_table(TABLES["inverse"], records, run, protocol="single-image")


HARD = [
    "<b>bold</b>", "*a*", "**a**", "_x_", "a_b_c", "`code`", "a ` b", "[text](http://a.b)", "![i](x)", "[a][b]",
    "[Uni]", "a*", "2 * 3 * 4", "<script>alert(1)</script>", "<!-- a -->", "a < b > c", "&lt;", "AT&T", "&amp;amp;",
    "a|b", r"a\|b", r"a\*b*", "C:\\", "~~gone~~", "$x$ and $y$", "<http://a.b>", "__a__", "*`a`*", "``a``",
]  # fmt: skip
BEGINNINGS = ["# a", "- a", "+ a", "* a", "1. a", "2) a", "> a", "[a]", "~~~", "---", "***", "```"]


def rendered(text: str, **enabled: bool) -> list[tuple[str, list[str]]]:
    """(Type, types of its parts with their text) of each inline block, read by another implementation of Markdown."""
    tokens = MarkdownIt("commonmark", {"html": True}).enable(["table", "strikethrough"]).parse(text)
    return [
        (tokens[i - 1].type, [f"{part.type}: {part.content}" for part in token.children or ()])
        for i, token in enumerate(tokens)
        if token.type == "inline"
    ]


@pytest.mark.parametrize("name", HARD + BEGINNINGS)
def test_a_strangers_name_and_note_are_text_in_markdown(name: str) -> None:
    """As they were given, in the row's cell and in the note below, with nothing marked up in either."""
    blocks = rendered(to_markdown(named(name, note=f"of {name}")))
    cells = [parts for kind, parts in blocks if kind == "td_open"]
    assert "".join(part.removeprefix("text: ") for part in cells[0]) == name
    if "`" not in name:  # code in a sentence is kept, since our own sentences have it
        (note,) = [parts for kind, parts in blocks if kind == "paragraph_open" and f"of {name}" in flat(parts)]
        assert flat(note) == f"{name}: of {name}"
    assert not {kind for kind, _ in blocks} - {"td_open", "th_open", "paragraph_open", "heading_open"}
    assert sum(kind == "heading_open" for kind, _ in blocks) == 1


def flat(parts: list[str]) -> str:
    """The text; empty where something is marked up."""
    return "".join(p.removeprefix("text: ") for p in parts) if all(p.startswith("text: ") for p in parts) else ""


@pytest.mark.parametrize("name", ["<b>bold</b>", "*a*", "_x_", "`code`", "[text](http://a.b)", "&lt;", "~~gone~~"])
def test_what_is_not_escaped_is_marked_up(name: str) -> None:
    """The twin: the other implementation does notice."""
    ((_, parts),) = rendered(name)
    assert flat(parts) != name


def test_our_own_names_and_sentences_are_left_as_they_are() -> None:
    text = to_markdown(table())
    assert "| InPix2Pix* |" in to_markdown(
        build_table(
            TABLES["rendering"],
            [replace(r, table="rendering", protocol="from-image") for r in RECORDS],
            RUN,
            protocol="from-image",
            variant=Variant("whole"),
        )
    )
    assert "| Ours (mean) [Uni-Renderer] |" in text
    ours = "see `unirender bench physics`, my_method (roughness >= 0.3)"
    assert plain_paragraph(ours) == ours
    line = TextTable("t", ("a", "b"), (((r"<b>|`transport.rounds = 0`", "27.50 (**-2.12 ± 1.83**)"),),)).markdown()
    line = line.replace(NO_BREAK, " ")
    assert line.splitlines()[4] == r"| &lt;b>\|`transport.rounds = 0` | 27.50 (**-2.12 ± 1.83**) |"


def test_a_name_on_two_lines_is_one_row() -> None:
    lines = [line for line in to_markdown(named("two\nlines")).splitlines() if line.startswith("|")]
    assert len(lines) == 3
    assert lines[2].startswith("| two lines |")


def test_latex_says_what_it_needs() -> None:
    text = to_latex(table())
    assert text.splitlines()[0] == r"% Needs \usepackage{booktabs,graphicx}."
    assert text.splitlines()[1].startswith(r"\begin{table*}")
    for label in ("λ-Net", "Αθηνα", "Müller", "e\u0301cole", "\u201cx\u201d"):
        assert "lualatex" not in to_latex(named(label)), label
    greek = to_latex(named("λ-Net, Ω"))
    assert r"$\lambda$-Net, $\mathrm{\Omega}$" in greek
    assert greek.isascii() or set(re.sub(r"[\x00-\x7f]", "", greek)) <= {"é"}


@pytest.mark.parametrize("letters", ["東京", "Ж", "Đ", "ή"])
def test_latex_says_which_letters_pdflatex_has_not(letters: str) -> None:
    line = to_latex(named(f"a {letters} b")).splitlines()[1]
    assert line == f"% Needs lualatex or xelatex, and a font that has {' '.join(sorted(letters))}: pdflatex has not."


def test_json_is_strict_and_whole() -> None:
    infinite = [replace(r, values={"albedo.psnr@masked-srgb-raw": math.inf}) for r in inverse("ours")]
    found = build_table(TABLES["inverse"], infinite, RUN, protocol="single-image")
    data = json.loads(to_json([found]), parse_constant=pytest.fail)
    cell = data[0]["rows"][0]["cells"][0]["measured"]
    assert (cell["mean"], cell["low"], cell["n"]) == ("inf", None, 8)
    assert "∞" in to_markdown(found)


def test_terminal_output_keeps_its_width() -> None:
    for width in (80, 200):
        assert max(map(len, printed(table(), width).splitlines())) <= width


@pytest.mark.parametrize("width", [60, 80, 100])
def test_a_narrow_terminal_cuts_no_number_short(width: int) -> None:
    """A group of columns that is too wide is split, and every block names its methods."""
    text = printed(table(), width).partition("Protocol")[0]
    assert "…" not in text
    blocks = text.split("Method")[1:]
    assert len(blocks) > 1 or width == 100
    for block in blocks:
        assert "Ours (mean)" in block
    nothing = re.compile(r"^ ?\S+(?: \S+)* {2,}-(?: {2,}-)* *$", re.MULTILINE)
    assert not nothing.findall(text), "a row that says nothing in a part is left out of it"
    assert nothing.findall(" InPix2Pix*      -         - ")


@pytest.mark.parametrize(("width", "blocks"), [(80, 2), (120, 1)])
def test_groups_share_a_block_where_they_fit(width: int, blocks: int) -> None:
    """Each block of a narrow terminal repeats all labels."""
    spec = replace(TABLES["inverse"], columns=TABLES["inverse"].columns[:1] + TABLES["inverse"].columns[5:7])
    found = build_table(spec, RECORDS, RUN, protocol="single-image", variant=WHOLE)
    assert [column.group for column in found.columns] == ["Albedo", "Metallic", "Roughness"]
    assert printed(found, width).count("Method") == blocks


def test_what_several_tables_say_alike_is_printed_once() -> None:
    buffer = StringIO()
    tables = [table("whole"), table("masked")]
    print_tables(Console(file=buffer, width=5000), tables)
    text = buffer.getvalue()
    assert [text.count(f"{name}: ") for name in ("variant", "suite", "truth", "exposure")] == [2, 1, 1, 1]
    for note in {*tables[0].notes, *tables[1].notes}:
        assert text.count(note) == 1
    alone = StringIO()
    print_tables(Console(file=alone, width=200), tables[:1])
    assert alone.getvalue() == printed(tables[0])


def test_a_table_of_texts_is_no_wider_than_its_longest_words() -> None:
    """Rich takes as much from each wide column, and makes the table wider again where one has a long word."""
    rows = (("an-identifier-in-one-piece", "five words are a sentence " * 2),)
    for width in range(46, 100):
        buffer = StringIO()
        TextTable("Words", ("what", "said"), (rows,)).show(Console(file=buffer, width=width))
        assert max(map(len, buffer.getvalue().splitlines())) <= width
        assert rows[0][0] in buffer.getvalue()


def test_a_terminal_that_is_too_narrow_for_any_table_gets_every_number() -> None:
    narrow, wide = (re.findall(r"\d+\.\d+", printed(table(), width)) for width in (20, 200))
    assert set(narrow) == set(wide)
    assert "…" not in printed(table(), 20)


@pytest.mark.parametrize("width", [10, 80])
def test_a_table_of_texts_has_every_number_in_one_piece(width: int) -> None:
    buffer, cells = StringIO(), [f"{10 * i + 0.123456}" for i in range(8)]
    texts = TextTable("Times", ("what", *"abcdefgh"), ((("a row", *cells),),))
    texts.show(Console(file=buffer, width=width))
    assert set(cells) <= set(buffer.getvalue().split())


def test_a_column_that_nobody_was_asked_for_is_left_out() -> None:
    relit = [
        Record("relighting", "from-image-hdri", "ours", f"s{i}", f"o{i}", {"relit.psnr@masked-srgb-raw": 20.0 + i})
        for i in range(3)
    ]
    (found,) = build_tables(relit, RUN)
    assert {column.group for column in found.columns} == {"Relit"}


def test_subsets_are_never_mixed() -> None:
    textured = [replace(record, subset="textured") for record in inverse("ours")]
    found = build_tables([*inverse("ours", 4), *textured], RUN)
    assert [(t.subset, t.variant.mask, t.n) for t in found] == [
        ("main", "whole", 4), ("main", "masked", 4), ("textured", "masked", 8)
    ]  # fmt: skip


def test_a_table_of_ones_own() -> None:
    column = Column("Superposition", "superposition", METRICS["mse"], {"mask": "masked"}, published=False)
    spec = TableSpec("physics", "Physics", (column,), ("physics",), description="What it is about.")
    values: Mapping[str, float] = {"superposition.mse@masked": 0.01}
    records = [Record("physics", "physics", "ours", f"s{i}", f"o{i}", values) for i in range(3)]
    (found,) = build_tables(records, RUN, {"physics": spec})
    assert found.rows[0].cells[0].measured is not None
    assert found.notes[0] == spec.description
    with pytest.raises(UnirenderError, match="expected one of"):
        build_table(spec, records, RUN, protocol="given")


def test_verdicts_pair_by_sample() -> None:
    chosen = Selection("inverse", "single-image").of(RECORDS)
    key = metric_key("metallic", "mse")
    found = compare(chosen, METRICS["mse"], key, "ours", "constant")
    assert (found.verdict, found.difference.n) == ("beats", 8)  # lower is better
    assert compare(chosen, METRICS["mse"], key, "constant", "ours").verdict == "is beaten by"
    assert compare(chosen, METRICS["mse"], key, "ours", "ours").verdict == "is level with"
    pairs = {(v.a, v.b, column.group) for column, v in verdicts(TABLES["inverse"], chosen, RUN)}
    assert ("ours", "constant", "Metallic") in pairs
    assert ("sample", "input", "Albedo") in pairs
    with pytest.raises(UnirenderError, match="has no value"):
        compare(chosen, METRICS["mse"], key, "input", "ours")


@pytest.mark.parametrize(("by", "verdict"), [(6e-7, "is level with"), (1e-2, "beats")])
def test_rounding_on_another_machine_beats_nothing(by: float, verdict: str) -> None:
    key = metric_key("albedo", "psnr")
    more = [
        replace(r, method="sample", values={key: r.values[key] + by * (1 + i)}) for i, r in enumerate(inverse("ours"))
    ]
    found = compare([*inverse("ours"), *more], METRICS["psnr"], key, "sample", "ours")
    assert found.difference.low > 0
    assert found.verdict == verdict


@pytest.mark.parametrize(("differing", "verdict"), [(0, "is level with"), (1, "is not told from"), (12, "beats")])
def test_rounding_does_not_add_to_a_difference(differing: int, verdict: str) -> None:
    """One object of twenty that differs decides nothing, whichever way the others were rounded."""
    key = metric_key("albedo", "psnr")
    records = [
        Record("inverse", "single-image", method, f"s{i}", f"o{i}", {key: 20.0 + by})
        for i in range(20)
        for method, by in (("ours", 0.0), ("sample", 0.01 if i < differing else 1e-6))
    ]
    assert compare(records, METRICS["psnr"], key, "sample", "ours").verdict == verdict


@pytest.mark.parametrize(
    ("scale", "exact", "ranks", "said"),
    [
        ("aligned_rgb", 2, [1, None, 2], "exact fit"),
        ("aligned_rgb", 4, [1, None, 2], "exact fit"),
        ("raw", 2, [1, None, 2], "truth to the bit"),
        ("raw", 4, [2, 1, None], None),
    ],
)
def test_a_mean_that_is_infinite_by_a_fit_or_by_a_part_is_not_ranked_and_is_counted(
    scale: Any, exact: int, ranks: list[int | None], said: str | None
) -> None:
    variant = Variant(scale=scale)
    levels = {"ours": [21.0] * 4, "constant": [math.inf] * exact + [12.0] * (4 - exact), "input": [12.0] * 4}
    records = [
        Record("inverse", "single-image", method, f"s{i}", f"o{i}", {metric_key("albedo", "psnr", variant): value})
        for method, values in levels.items()
        for i, value in enumerate(values)
    ]
    found = build_table(TABLES["inverse"], records, RUN, protocol="single-image", variant=variant)
    assert [r.cells[0].measured_rank for r in found.rows] == ranks
    assert "| Constant 0.5 | " in (text := to_markdown(found))
    assert "∞" in text
    assert (f"Constant 0.5 (Albedo PSNR: {exact} of 4 samples)" in text) == (said is not None)
    assert said is None or said in text
