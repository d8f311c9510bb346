"""Methods that are not installed: found by file or by module, and every way in which that can fail, named."""

import hashlib
import subprocess
import sys
from collections.abc import Iterator
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import numpy as np
import pytest

from unirender.errors import UnirenderError, UsageError
from unirender.intrinsics import Intrinsics
from unirender_evaluation import engine
from unirender_evaluation.methods import kept_defaults
from unirender_evaluation.methods.plugin_source import source_sha256
from unirender_evaluation.methods.plugins import installed_plugins, named_plugin
from unirender_evaluation.rows import plugin_rows
from unirender_reference.backend import LLVM_VARIABLE, find_llvm, mitsuba

SOURCE = """
from helper_of_the_method import SHADE


class Grey:
    name = "grey"
    config = {"shade": SHADE}

    def render(self, intrinsics):
        return SHADE * intrinsics.albedo * intrinsics.mask


class Empty:
    name = "empty"
    config = {}


class Broken(Grey):
    def __init__(self):
        raise RuntimeError("no weights")


class Sampler(Grey):
    config = {"steps": 4, "samples": "many", "seed": 7}


class Unwritable(Grey):
    config = {"weights": object()}


class NotANumber(Grey):
    config = {"threshold": float("nan")}


class White(Grey):
    pass


def make():
    return Grey()


class Level:
    name = "level"
    config = {}

    def __init__(self, level: float = 0.5):
        self.level = level

    def render(self, intrinsics):
        return self.level * intrinsics.albedo * intrinsics.mask


class Loaded(Grey):
    def __init__(self, weights, steps=4, **more):
        self.weights = weights


instance = Grey()
bright, dark = Level(0.9), Level(0.1)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setattr(sys, "path", list(sys.path))  # which plug-ins add to
    (tmp_path / "my_method.py").write_text(SOURCE)
    (tmp_path / "helper_of_the_method.py").write_text("SHADE = 0.5\n")
    yield tmp_path
    for name, module in list(sys.modules.items()):
        if str(getattr(module, "__file__", None)).startswith(str(tmp_path)):
            del sys.modules[name]


@pytest.mark.parametrize("name", ["Grey", "make", "instance"])
def test_a_file_with_its_neighbours(folder: Path, name: str) -> None:
    plugin = named_plugin(f"{folder / 'my_method.py'}:{name}")
    assert plugin.method.name == "grey"
    assert len(plugin.source) == 64


def test_steps_and_seed_of_a_method_are_stated(folder: Path) -> None:
    """What is no whole number is not taken for one."""
    sampler, grey = plugin_rows([named_plugin(f"{folder / 'my_method.py'}:{name}") for name in ("Sampler", "Grey")])
    assert (sampler.info.steps, sampler.info.samples, sampler.info.seed) == (4, None, 7)
    assert (grey.info.steps, grey.info.samples, grey.info.seed) == (None, None, None)


def test_a_module_of_the_current_directory(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    (folder / "module_in_the_current_directory.py").write_text(SOURCE)
    row = plugin_rows([named_plugin("module_in_the_current_directory:Grey")])[0]
    assert (row.info.key, row.info.kind) == ("grey", "external")


def test_an_edited_file_is_another_configuration(folder: Path) -> None:
    """Records of a method whose source has changed are stale, whatever its config says."""
    (folder / "copy.py").write_text(f"{SOURCE}\n# edited\n")
    rows = plugin_rows([named_plugin(f"{folder / name}:Grey") for name in ("my_method.py", "copy.py")])
    assert rows[0].info.config != rows[1].info.config
    assert rows[0].info.config["shade"] == rows[1].info.config["shade"] == 0.5


@pytest.mark.parametrize(
    ("one", "other"),
    [("Grey", "White"), ("bright", "dark"), ("Level?level=0.2", "Level?level=0.3"), ("Grey", "make")],
)
def test_methods_of_one_file_share_no_record(folder: Path, one: str, other: str) -> None:
    """Whatever their `config` says: else the numbers of the one are printed as the other's."""
    rows = plugin_rows([named_plugin(f"{folder / 'my_method.py'}:{name}") for name in (one, other)])
    assert rows[0].config != rows[1].config
    (again,) = plugin_rows([named_plugin(f"{folder / 'my_method.py'}:{one}")])
    assert again.config == rows[0].config


def test_a_row_of_another_name_shares_no_record(folder: Path) -> None:
    """A name that is an argument, or read from elsewhere when the method is made."""
    first, second = (named_plugin(f"{folder / 'my_method.py'}:Grey") for _ in range(2))
    second.method.name = "grey, renamed"
    rows = plugin_rows([first, second])
    assert rows[0].config != rows[1].config


@pytest.mark.parametrize("made", ["def make():\n    return Level({level})\n", "make = Level({level})\n"])
def test_an_edited_factory_is_another_configuration(folder: Path, made: str) -> None:
    """Its class may stand in another file, which is the same."""
    sources = []
    for level in (0.1, 0.9):
        file = folder / f"factory_{level}.py"
        file.write_text(f"from my_method import Level\n\n\n{made.format(level=level)}")
        sources.append(named_plugin(f"{file}:make").source)
    assert sources[0] != sources[1]


@pytest.mark.parametrize("edited", ["base.py", "parts/late.py", "parts/__init__.py", "constants.py", "deep.py"])
def test_an_edited_neighbour_is_another_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, edited: str
) -> None:
    """Of a base class, imported late, or below a package: whatever else is imported, and whether it has run or not."""
    files = {
        "main.py": "from base import Base\nclass Mine(Base):\n    def render(self, intrinsics): import parts.late",
        "base.py": "from constants import ONE\nclass Base:\n    name, config = 'mine', {}",
        "constants.py": "import deep\nONE = 1",
        "deep.py": "",
        "parts/__init__.py": "",
        "parts/late.py": "from .absent import nothing",
        "other.py": "ONE = 1",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)

    monkeypatch.syspath_prepend(str(tmp_path))
    for name in ("base", "constants", "deep", "parts", "parts.late"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    kind = type(named_plugin(f"{tmp_path / 'main.py'}:Mine").method)
    before = source_sha256(kind, kind)
    assert named_plugin(f"{tmp_path / 'main.py'}:Mine").source == before
    (tmp_path / "other.py").write_text("ONE = 2")
    assert source_sha256(kind, kind) == before
    with (tmp_path / edited).open("a") as file:
        file.write("\n# edited\n")
    assert source_sha256(kind, kind) != before


def test_an_edited_package_elsewhere_is_another_configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that the method puts on the path, as one installed for editing is, and what it imports; nothing beside it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    package = tmp_path / "src" / "my_edited_package"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("from .net import Net")
    (package / "net.py").write_text("class Net: ...")
    (package / "other.py").write_text("")
    file = tmp_path / "adapter" / "mine.py"
    file.parent.mkdir()
    file.write_text(
        f"import sys\nsys.path.append({str(package.parent)!r})\nfrom my_edited_package import Net\n"
        "class Mine:\n    name, config = 'mine', {}\n    def render(self, intrinsics): ..."
    )
    kind = type(named_plugin(f"{file}:Mine").method)
    before = source_sha256(kind, kind)
    (package / "other.py").write_text("# edited")
    assert source_sha256(kind, kind) == before
    (package / "net.py").write_text("class Net: ...  # edited")
    assert source_sha256(kind, kind) != before


def test_a_method_that_was_edited_after_its_import_is_refused(folder: Path) -> None:
    """As the second run of a notebook has it: Python would run the old one, under the name of the new one's file."""
    named_plugin(f"{folder / 'my_method.py'}:Grey")
    named_plugin(f"{folder / 'my_method.py'}:Grey")
    (folder / "my_method.py").write_text(SOURCE.replace("return SHADE", "return 2 * SHADE"))
    with pytest.raises(UnirenderError, match=r"my_method\.py:Grey: its files were edited after .* restart the kernel"):
        named_plugin(f"{folder / 'my_method.py'}:Grey")


def test_a_method_of_a_session_is_refused(tmp_path: Path) -> None:
    """It has no file, so that the stored numbers would count for an edited one, too."""
    session = (
        "from unirender_evaluation.methods.plugins import named_plugin\n"
        "class Mine:\n    name, config = 'mine', {}\n    def render(self, intrinsics): ...\n\n"
        "named_plugin('__main__:Mine')"
    )
    done = subprocess.run(
        [sys.executable, "-"], input=session, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "--method __main__:Mine: Mine is defined in no file, expected one" in done.stderr


def test_neighbours_of_one_name_are_not_mistaken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two copies of a method, each with its own net: Python would give the second the first one's."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    for level, copy in enumerate(("one", "two")):
        (tmp_path / copy).mkdir()
        (tmp_path / copy / "copy.py").write_text("")  # named as one of Python's, which is meant
        (tmp_path / copy / "my_shadowed_net.py").write_text(f"LEVEL = {level}")
        (tmp_path / copy / "mine.py").write_text(
            "import copy\nfrom my_shadowed_net import LEVEL\n"
            f"class Mine:\n    name, config = '{copy}', {{}}\n    def render(self, intrinsics): ..."
        )
    named_plugin(f"{tmp_path}/one/mine.py:Mine")
    said = r"in place of .*/two/my_shadowed_net\.py Python imports .*/one/my_shadowed_net\.py; rename"
    with pytest.raises(UnirenderError, match=said):
        named_plugin(f"{tmp_path}/two/mine.py:Mine")


def test_what_a_method_sets_for_the_whole_process_is_its_own(tmp_path: Path) -> None:
    """Else LPIPS, and our own rows, would run in float64 or elsewhere; and without it the method's net would not fit
    to what it makes in its next call. Two of a file have what its import set, and each its own."""
    import torch

    file = tmp_path / "setting.py"
    file.write_text(
        "import numpy as np\nimport torch\ntorch.set_default_dtype(torch.float64)\nnp.seterr(divide='raise')\n"
        "class Mine:\n    name, config = 'mine', {}\n"
        "    def __init__(self):\n        torch.set_default_device('meta')\n"
        "    def render(self, intrinsics):\n        self.saw = torch.ones(2), np.geterr()['divide']\n"
        "        np.seterr(over='raise')\n        return np.zeros((2, 2, 3))\n"
        "class Other(Mine):\n    def __init__(self): ..."
    )
    before, errors = (torch.get_default_dtype(), torch.get_default_device()), np.geterr()
    for name, device in (("Mine", "meta"), ("Other", "cpu")):
        (row,) = plugin_rows([named_plugin(f"{file}:{name}")])
        for _ in range(2):
            engine.ask(row, "render", "x", intrinsics=Intrinsics(albedo=np.zeros((2, 2, 3), np.float32)))
            made, divide = row.method.saw
            assert (made.dtype, made.device.type, divide) == (torch.float64, device, "raise")
            assert (torch.get_default_dtype(), torch.get_default_device()) == before
            assert np.geterr() == errors


def test_an_error_names_the_line_of_the_method_that_met_it(tmp_path: Path) -> None:
    """And not that of the library which raised it, which says nothing to its author."""
    file = tmp_path / "wide.py"
    file.write_text(
        "import json\nclass Wide:\n    name, config = 'wide', {}\n"
        "    def render(self, intrinsics):\n        return json.loads('{')\n"
    )
    (row,) = plugin_rows([named_plugin(f"{file}:Wide")])
    with pytest.raises(UnirenderError, match=r"JSONDecodeError: .* \(wide.py, line 5\)$"):
        engine.ask(row, "render", "x", intrinsics=Intrinsics(albedo=np.zeros((2, 2, 3), np.float32)))


def test_how_torch_computes_is_a_methods_own(tmp_path: Path) -> None:
    """A script's `set_grad_enabled(False)` would leave the next method without gradients, and reduced precision would
    reach the answers of our rows."""
    settings = (
        "torch.set_grad_enabled(False)",
        "torch.backends.cuda.matmul.allow_tf32 = True",
        "torch.backends.cudnn.benchmark = True",
        "torch.set_num_threads(torch.get_num_threads() + 1)",
    )
    file = tmp_path / "settings.py"
    file.write_text(
        "import numpy as np\nimport torch\nclass Sets:\n    name, config = 'sets', {}\n    def __init__(self):\n"
        + "".join(f"        {setting}\n" for setting in settings)
        + "    def render(self, intrinsics):\n"
        "        assert not torch.is_grad_enabled() and torch.backends.cuda.matmul.allow_tf32\n"
        "        assert torch.backends.cudnn.benchmark\n        return np.zeros((2, 2, 3))\n"
        "class Learns:\n    name, config = 'learns', {}\n    def render(self, intrinsics):\n"
        "        torch.ones(2, requires_grad=True).sum().backward()\n        return np.zeros((2, 2, 3))\n"
    )
    before = kept_defaults.torch_defaults()
    rows = plugin_rows([named_plugin(f"{file}:{name}") for name in ("Sets", "Learns")])
    for row in (*rows, *rows):
        engine.ask(row, "render", "x", intrinsics=Intrinsics(albedo=np.zeros((2, 2, 3), np.float32)))
        assert kept_defaults.torch_defaults() == before


@pytest.mark.parametrize(
    "setting",
    [
        "torch.backends.fp32_precision = 'bf16'",
        "torch.backends.fp32_precision = 'tf32'",
        "torch.backends.mkldnn.conv.fp32_precision = 'bf16'",
        "torch.backends.cudnn.conv.fp32_precision = 'ieee'",
    ],
)
def test_a_precision_that_torchs_newer_interface_sets_is_a_methods_own(tmp_path: Path, setting: str) -> None:
    """The networks of other rows convolve on the same processor."""
    file = tmp_path / "precise.py"
    file.write_text(
        f"import numpy as np\nimport torch\n{setting}\nclass Precise:\n    name, config = 'precise', {{}}\n"
        f"    def render(self, intrinsics):\n        assert {setting.replace(' = ', ' == ')}\n"
        "        return np.zeros((2, 2, 3))\n"
    )
    before = kept_defaults.torch_defaults()
    (row,) = plugin_rows([named_plugin(f"{file}:Precise")])
    for _ in range(2):
        assert kept_defaults.torch_defaults() == before
        engine.ask(row, "render", "x", intrinsics=Intrinsics(albedo=np.zeros((2, 2, 3), np.float32)))
    assert kept_defaults.torch_defaults() == before


def test_a_method_finds_its_own_variant_of_mitsuba(tmp_path: Path) -> None:
    """Though the truth check, rows of ours, and other methods render with another one between its calls; also that
    which was there when it set it.
    """
    rows = []
    for name, variant in (("first", "scalar_rgb"), ("second", "scalar_rgb"), ("other", "scalar_spectral_polarized")):
        file = tmp_path / f"{name}.py"
        file.write_text(
            f"import mitsuba as mi\nimport numpy as np\nmi.set_variant('{variant}')\n"
            f"class Renders:\n    name, config = '{name}', {{}}\n    def render(self, intrinsics):\n"
            f"        assert mi.variant() == '{variant}'\n        return np.zeros((2, 2, 3))\n"
        )
        rows += plugin_rows([named_plugin(f"{file}:Renders")])
    for row in (*rows, *rows):
        mitsuba("scalar_spectral")
        engine.ask(row, "render", "x", intrinsics=Intrinsics(albedo=np.zeros((2, 2, 3), np.float32)))


def test_a_method_that_imports_mitsuba_before_us_loads_our_llvm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of an older one, which Dr.Jit finds by itself, all rows that render would say that it is too old."""
    monkeypatch.delenv(LLVM_VARIABLE, raising=False)
    (tmp_path / "mine.py").write_text(
        f"import os\nclass Mine:\n    name, config = 'mine', {{'llvm': os.environ.get('{LLVM_VARIABLE}')}}\n"
        "    def render(self, intrinsics): ..."
    )
    assert named_plugin(f"{tmp_path}/mine.py:Mine").method.config["llvm"] == str(find_llvm().path)


def test_a_compiled_neighbour_is_its_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Python prefers the one that Cython or mypyc has left beside it."""
    monkeypatch.setattr(sys, "path", list(sys.path))
    for suffix in (".py", EXTENSION_SUFFIXES[0]):
        (tmp_path / f"my_compiled_net{suffix}").write_text("")
    (tmp_path / "mine.py").write_text(
        "class Mine:\n    name, config = 'mine', {}\n    def render(self, intrinsics): import my_compiled_net"
    )
    named_plugin(f"{tmp_path}/mine.py:Mine")


def test_a_method_may_change_the_folder_that_it_runs_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All others stay where they are: else a relative --out would lie elsewhere, and a relative --method be gone."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "weights").mkdir()
    (tmp_path / "walker.py").write_text(
        "import os\nimport numpy as np\nclass Walker:\n    name, config = 'walker', {}\n"
        "    def __init__(self):\n        os.chdir('weights')\n"
        "    def render(self, intrinsics):\n        self.saw = os.getcwd()\n        return np.zeros((2, 2, 3))"
    )
    for _ in range(2):
        (row,) = plugin_rows([named_plugin("walker.py:Walker")])
        for _ in range(2):
            engine.ask(row, "render", "x", intrinsics=Intrinsics(albedo=np.zeros((2, 2, 3), np.float32)))
            assert row.method.saw == str(tmp_path / "weights")
            assert Path.cwd() == tmp_path


def test_nothing_of_pythons_own_library_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else another patch version of Python would be another method."""
    bodies = {"plain_mine": "class Mine:\n", "abstract_mine": "from abc import ABC\nclass Mine(ABC):\n"}
    for name, head in bodies.items():
        (tmp_path / f"{name}.py").write_text(
            head + "    name, config = 'mine', {}\n    def render(self, intrinsics): ...\n"
        )
    monkeypatch.syspath_prepend(str(tmp_path))
    for name in bodies:
        kind = type(named_plugin(f"{name}:Mine").method)
        own = hashlib.sha256((tmp_path / f"{name}.py").read_bytes()).digest()
        assert source_sha256(kind, kind) == hashlib.sha256(own).hexdigest()


def test_an_installed_method_is_its_own_package_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not all that lies beside it, whose number has no end."""
    packages = tmp_path / "site-packages"
    (packages / "mine_installed").mkdir(parents=True)
    (packages / "mine_installed" / "__init__.py").write_text(
        "import foreign_installed\nfrom .net import Net\nclass Mine(Net):\n    name, config = 'mine', {}"
    )
    (packages / "mine_installed" / "net.py").write_text("class Net:\n    def render(self, intrinsics): ...")
    (packages / "foreign_installed.py").write_text("")
    monkeypatch.syspath_prepend(str(packages))
    kind = type(named_plugin("mine_installed:Mine").method)
    before = source_sha256(kind, kind)
    (packages / "foreign_installed.py").write_text("# edited")
    assert source_sha256(kind, kind) == before
    (packages / "mine_installed" / "net.py").write_text("# edited")
    assert source_sha256(kind, kind) != before


def test_a_folder_shadows_no_module_of_python(folder: Path) -> None:
    """Worker processes start with this search path: a file named like one of Python's own must not break them."""
    (folder / "copy.py").write_text("raise RuntimeError('not this one')\n")
    named_plugin(f"{folder / 'my_method.py'}:Grey")
    code = f"import sys; sys.path = {sys.path!r}; import copy, helper_of_the_method; copy.deepcopy([])"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    first = f"import sys; sys.path.insert(0, {str(folder)!r}); import copy"
    assert subprocess.run([sys.executable, "-c", first], check=False, stderr=subprocess.DEVNULL).returncode != 0


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("{folder}/absent.py:Grey", "no file .*absent.py, expected module:Class or path/to/file.py:Class"),
        ("{folder}/my_method.py:Gray", "has no 'Gray'; of what it has, Grey, .* has one of decompose"),
        ("{folder}/my_method.py:Empty", "is not a method"),
        (
            "{folder}/my_method.py:Loaded",
            "it takes weights, expected a value of each, as in .*Loaded.weights=VALUE",
        ),
        (
            "{folder}/my_method.py:Broken",
            r"could not construct it: RuntimeError: no weights \(my_method.py, line \d+\)$",
        ),
        ("{folder}/syntax.py:Grey", "could not import it: SyntaxError"),
        ("{folder}/imports.py:Grey", "could not import it: ModuleNotFoundError: No module named 'no_such_package'"),
        ("no_such_module_here:Grey", "no module 'no_such_module_here' in "),
        ("json.no_such_part:Grey", "no module 'json.no_such_part' in "),
    ],
)
def test_what_is_wrong_is_named(folder: Path, spec: str, message: str) -> None:
    (folder / "syntax.py").write_text("class Grey(:\n")
    (folder / "imports.py").write_text("import no_such_package\n")
    with pytest.raises(UnirenderError, match=message):
        named_plugin(spec.format(folder=folder))


@pytest.mark.parametrize("spec", ["Grey", "my_method.py", ":Grey", "my_method:", "my_method:a.b"])
def test_another_form_is_wrong_usage(spec: str) -> None:
    with pytest.raises(UsageError, match=r"expected module:Class or path/to/file\.py:Class"):
        named_plugin(spec)


@pytest.mark.parametrize("name", ["Unwritable", "NotANumber"])
def test_a_config_that_is_not_json(folder: Path, name: str) -> None:
    with pytest.raises(UnirenderError, match="method 'grey': its config is not JSON"):
        plugin_rows([named_plugin(f"{folder / 'my_method.py'}:{name}")])


def install(folder: Path, name: str, module: str, entries: str) -> None:
    """A distribution as pip leaves it, in a folder that is to be on Python's path."""
    information = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    information.mkdir(parents=True)
    (information / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(f"[unirender.methods]\n{entries}\n")
    (folder / f"{module}.py").write_text(
        f"class Mine:\n    name, config = '{name}', {{}}\n    def render(self, intrinsics): ...\n"
        "def broken():\n    raise RuntimeError('no weights')\n"
    )


def test_all_installed_methods_are_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of two distributions that chose one name for theirs; of a broken one it is said how to go on."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *sys.path])
    for number in ("one", "two"):
        install(tmp_path, f"installed-{number}", f"my_installed_{number}", f"mine = my_installed_{number}:Mine")
    assert {"installed-one", "installed-two"} <= {plugin.method.name for plugin in installed_plugins()}
    install(tmp_path, "installed-three", "my_installed_three", "mine = my_installed_three:broken")
    said = "no weights .*; mend or uninstall installed-three, or run without it: leave plugins out of --methods"
    with pytest.raises(UnirenderError, match=said):
        installed_plugins()
