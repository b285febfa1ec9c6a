"""Model files that were made to do harm: nothing in them is run, and they are refused in one sentence."""

import copy
import io
import json
import os
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from advsearch import load_model
from advsearch.errors import FileFormatError
from advsearch.trust import archives
from advsearch.trust import exported_programs as reader

Program = dict[str, Any]

TABLES = ("data/weights/model_weights_config.json", "data/constants/model_constants_config.json")


pytestmark = pytest.mark.usefixtures("one_thread")


class Net(nn.Module):
    """A parameter, a buffer, text as an argument, and arithmetic with the size of the batch."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.linspace(-1, 1, 36).reshape(3, 12))
        self.shift: Tensor
        self.register_buffer("shift", torch.ones(12))

    def forward(self, x: Tensor) -> Tensor:
        cells = nn.functional.gelu(nn.functional.adaptive_avg_pool2d(x, 2), approximate="tanh").flatten(1)
        return ((cells + self.shift) @ self.weight.T).reshape(x.shape[0], -1)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "net.pt2"
    batch = torch.export.Dim("batch", min=1, max=4)
    program = torch.export.export(Net().eval(), (torch.rand(2, 3, 8, 8),), dynamic_shapes=({0: batch},))
    torch.export.save(program, path)
    return path


def repacked(source: Path, target: Path, changes: dict[str, bytes | None], method: int = zipfile.ZIP_STORED) -> Path:
    """Copy an archive with these members added, replaced or (None) left out; names without the root folder."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w", method) as new:
        root = old.namelist()[0].partition("/")[0]
        kept = {name.partition("/")[2]: old.read(name) for name in old.namelist()}
        for name, content in {**kept, **changes}.items():
            if content is not None:
                new.writestr(f"{root}/{name}", content)
    return target


def member(path: Path, ending: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        return archive.read(next(name for name in archive.namelist() if name.endswith(ending)))


def planted(source: Path, target: Path, plant: Callable[[Program], None]) -> Path:
    """Copy an exported program with its description, and the tables of its tensors, changed by `plant`."""
    parts = {name: json.loads(member(source, name)) for name in (*TABLES, "models/model.json")}
    program = parts["models/model.json"] | {name: parts[name] for name in TABLES}
    plant(program)
    parts = {name: program.pop(name) for name in TABLES} | {"models/model.json": program}
    return repacked(source, target, {name: json.dumps(part).encode() for name, part in parts.items()})


def _code(trace: Path) -> str:
    return f"__import__('os').mkdir({str(trace)!r})"


def _expression(where: str) -> Callable[[Program, Path], None]:
    def plant(program: Program, trace: Path) -> None:
        graph = program["graph_module"]["graph"]
        bad = {"as_expr": {"expr_str": _code(trace), "hint": {"as_int": 2}}}
        if where == "size":
            graph["tensor_values"]["x"]["sizes"][0] = bad
        elif where == "stride":
            graph["tensor_values"]["x"]["strides"][0] = bad
        elif where == "sym_bool":
            graph["sym_bool_values"]["evil"] = bad
        else:
            graph["sym_int_values"] = {name: bad for name in graph["sym_int_values"]}

    return plant


def _operator(target: str, **arguments: Any) -> Callable[[Program, Path], None]:
    """Add the call of an operator with the trace's path as text, and use its answer."""

    def plant(program: Program, trace: Path) -> None:
        graph = program["graph_module"]["graph"]
        user = next(node for node in graph["nodes"] if "as_tensor" in node["outputs"][0])
        node, output = copy.deepcopy(user), user["outputs"][0]["as_tensor"]["name"]
        graph["tensor_values"]["evil"] = graph["tensor_values"][output]
        inputs = {"filename": {"as_string": str(trace)}, **arguments}
        node |= {"target": target, "name": "evil", "outputs": [{"as_tensor": {"name": "evil"}}]}
        node["inputs"] = [{"arg": arg, "kind": 1, "name": name} for name, arg in inputs.items()]
        user["inputs"][0]["arg"]["as_tensor"]["name"] = "evil"
        graph["nodes"].insert(0, node)

    return plant


def _renamed(old: str, new: Callable[[Path], str]) -> Callable[[Program, Path], None]:
    """Give one value of the graph a name that is code."""

    def plant(program: Program, trace: Path) -> None:
        text = json.dumps(program).replace(json.dumps(old), json.dumps(new(trace)))
        program.clear()
        program.update(json.loads(text))

    return plant


def _guards(program: Program, trace: Path) -> None:
    program["guards_code"] = [_code(trace)]


def _module_to_import(program: Program, trace: Path) -> None:
    folder = trace.parent / "planted_module"
    folder.mkdir()
    (folder / "__init__.py").write_text(f"import os\nos.mkdir({str(trace)!r})\nx = dict\n")
    context = {"default_factory_module": "planted_module", "default_factory_name": "x", "dict_context": []}
    tree = {"type": "collections.defaultdict", "context": context, "children_spec": []}
    signature = program["graph_module"]["module_call_graph"][0]["signature"]
    signature["out_spec"] = json.dumps([1, tree])


PLANTED: dict[str, Callable[[Program, Path], None]] = {
    "expression of a size": _expression("size"),
    "expression of a stride": _expression("stride"),
    "expression of a truth value": _expression("sym_bool"),
    "expression of a whole number": _expression("sym_int"),
    "operator os.mkdir": _operator("torch.os.mkdir"),
    "operator load_library": _operator("torch.ops.load_library"),
    "operator from_file": _operator("torch.ops.aten.from_file.default", shared={"as_bool": True}, size={"as_int": 384}),
    "operator save": _operator("torch.ops.aten.save.default"),
    "operator of the operator module": _operator("_operator.attrgetter"),
    "name of an input": _renamed("x", lambda trace: f"x, evil={_code(trace)}"),
    "name of an input of the module": _renamed("x", lambda trace: f"x): pass\n{_code(trace)}\ndef g(x"),
    "name of a parameter": _renamed("weight", lambda trace: f'a" + {_code(trace)} + "'),
    "guards": _guards,
    "a module to import": _module_to_import,
}


@pytest.mark.parametrize("place", PLANTED)
def test_no_planted_command_runs(place: str, exported: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    trace = tmp_path / "executed"
    path = planted(exported, tmp_path / "planted.pt2", lambda program: PLANTED[place](program, trace))
    try:
        load_model(path)
    except FileFormatError as error:
        assert len(str(error)) < 800 + len(str(path)) and "\n" not in str(error)
    else:
        assert place == "guards"  # which are left away
    assert not trace.exists()


def test_a_pickle_in_place_of_a_weight_is_refused(exported: Path, tmp_path: Path) -> None:
    def plant(program: Program) -> None:
        next(iter(program[TABLES[0]]["config"].values()))["use_pickle"] = True

    with pytest.raises(FileFormatError, match="is a pickled object or compiled code, which is never loaded"):
        load_model(planted(exported, tmp_path / "pickled.pt2", plant))


def test_compiled_code_is_refused(exported: Path, tmp_path: Path) -> None:
    path = repacked(exported, tmp_path / "compiled.pt2", {"data/aotinductor/model/wrapper.so": b"\x7fELF"})
    with pytest.raises(FileFormatError, match=r"holds 'data/aotinductor/model/wrapper.so', which is .* compiled code"):
        load_model(path)


def test_a_tensor_without_data_takes_no_memory(exported: Path, tmp_path: Path) -> None:
    def plant(program: Program) -> None:
        entry = next(iter(program[TABLES[0]]["config"].values()))
        entry["path_name"] = "nothing"
        entry["tensor_meta"]["sizes"] = [{"as_int": 10**7}, {"as_int": 100}]

    path = planted(exported, tmp_path / "large.pt2", plant)
    path = repacked(path, tmp_path / "larger.pt2", {"data/weights/nothing": b""})
    with pytest.raises(FileFormatError, match="is empty, but should hold a tensor of"):
        load_model(path)


@pytest.mark.parametrize("sizes", [0, 7, True, "3", [3], [{"as_int": -1}], [{"as_int": "3"}], {"as_int": 3}])
def test_sizes_of_a_tensor_that_are_no_list_of_numbers_are_refused(
    exported: Path, tmp_path: Path, sizes: object
) -> None:
    def plant(program: Program) -> None:
        next(iter(program[TABLES[0]]["config"].values()))["tensor_meta"]["sizes"] = sizes

    with pytest.raises(FileFormatError, match="expected the sizes of a tensor for"):
        load_model(planted(exported, tmp_path / "sizes.pt2", plant))


def test_a_counter_of_sizes_ends(exported: Path, tmp_path: Path) -> None:
    """torch counts up to the number in the name of a size."""

    def plant(program: Program) -> None:
        program["range_constraints"]["u999999999999"] = {"min_val": 0, "max_val": 9}

    with pytest.raises(FileFormatError, match="expected arithmetic with whole numbers and symbols"):
        load_model(planted(exported, tmp_path / "counter.pt2", plant))


def test_archives_that_swell_are_refused(exported: Path, tmp_path: Path) -> None:
    zeros = bytes(64 << 20)
    path = repacked(exported, tmp_path / "bomb.pt2", {"data/weights/zeros": zeros}, zipfile.ZIP_DEFLATED)
    with pytest.raises(FileFormatError, match=r"unpacks to at most 20 times its size, .*ADVSEARCH_LIMITS"):
        load_model(path)


def test_members_have_plain_names_and_one_each(exported: Path, tmp_path: Path) -> None:
    path = repacked(exported, tmp_path / "up.pt2", {"../../up": b""})
    with pytest.raises(FileFormatError, match="has a member of the name"):
        load_model(path)
    path = repacked(exported, tmp_path / "double.pt2", {})
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr(archive.namelist()[0], b"")
    with pytest.raises(FileFormatError, match="has two members of one name"):
        load_model(path)


@pytest.mark.parametrize("depth", [200, 200_000])
def test_nested_descriptions_are_refused(depth: int, exported: Path, tmp_path: Path) -> None:
    text = b'{"graph_module": ' + b"[" * depth + b"]" * depth + b"}"
    path = repacked(exported, tmp_path / "deep.pt2", {"models/model.json": text})
    with pytest.raises(FileFormatError, match="nested deeper than"):
        load_model(path)


@pytest.mark.parametrize(
    "text",
    [
        "2*s77 + 1", "(s0 - 1)//32 + 1", "FloorDiv(Add(Symbol('s0', integer=True), Integer(-1)), Integer(32))",
        "Mul(Rational(1, 2), Symbol('s0'))", "Max(Integer(1), Min(Symbol('s1'), Integer(64)))",
        "Mul(Float('0.5', precision=53), ToFloat(Symbol('s0')))", "And(StrictLessThan(Integer(1), Symbol('s0')), true)",
    ],
)  # fmt: skip
def test_expressions_of_sizes_that_are_read(text: str) -> None:
    assert reader.find_expression_problem(text) == ""


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "s0.__class__", "(lambda: 1)()", "sympify('1')",
        "Symbol('s0', **{'a': True})", "Symbol('s0', positive=__import__('os').system('true'), positive=True)",
        "Float('1e999999999')", "Float('1', precision=10**9)", "9**9**9",
        "Pow(Pow(Integer(2), Integer(64)), Integer(64))", "1" * 50, "-" * 30_000 + "1", "(" * 300 + "1" + ")" * 300,
        "s0; s1", "x" * 5000, "Max(" + ", ".join(f"s{i}" for i in range(100)) + ")",
    ],
)  # fmt: skip
def test_expressions_that_are_none(text: str) -> None:
    message = reader.find_expression_problem(text)
    assert message and len(message) < 250


def scripted(module: nn.Module, path: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.jit.script(module.eval()).save(str(path))
    return path


class Scripted(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.linspace(-1, 1, 36).reshape(3, 12))
        self.note = "two\nlines"
        self.path = ""

    def forward(self, x: Tensor) -> Tensor:
        small = nn.functional.interpolate(x, (2, 2), mode="bilinear")
        return small.flatten(1) @ self.weight.T


class Saves(Scripted):
    def forward(self, x: Tensor) -> Tensor:
        torch.save(x, self.path)
        return x.mean((2, 3))


class MapsAFile(Scripted):
    def forward(self, x: Tensor) -> Tensor:
        return x.mean((2, 3)) + torch.from_file(self.path, True, 12)[:3]


class SavesWhileLoading(Scripted):
    @torch.jit.export
    def __getstate__(self) -> tuple[Tensor, str, bool]:
        return (self.weight, self.path, self.training)

    @torch.jit.export
    def __setstate__(self, state: tuple[Tensor, str, bool]) -> None:
        torch.save(state[0], state[1])
        self.weight, self.path, self.note, self.training = state[0], state[1], "", state[2]  # type: ignore


class Prints(Scripted):
    def forward(self, x: Tensor) -> Tensor:
        print("\x1b[2J")
        return x.mean((2, 3))


class NeverEnds(Scripted):
    def forward(self, x: Tensor) -> Tensor:
        i = 0
        while i >= 0:
            i = 0
        return x.mean((2, 3)) * i


class NeverEndsLoading(Scripted):
    @torch.jit.export
    def __getstate__(self) -> tuple[Tensor, bool]:
        return (self.weight, self.training)

    @torch.jit.export
    def __setstate__(self, state: tuple[Tensor, bool]) -> None:
        i = 0
        while i >= 0:
            i = 0
        self.weight, self.path, self.note, self.training = state[0], "", "", state[1]  # type: ignore


class SumsForYears(nn.Module):
    """Without a loop: a tensor of one number, as large as can be."""

    def forward(self, x: Tensor) -> Tensor:
        return x.mean((2, 3)) + x[0, 0, 0, :1].expand(10**15).sum()


@pytest.fixture(scope="module")
def script(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return scripted(Scripted(), tmp_path_factory.mktemp("models") / "net.pt")


@pytest.mark.parametrize("kind", [Saves, MapsAFile, SavesWhileLoading, Prints])
def test_torchscript_touches_nothing(kind: type[Scripted], tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    trace = tmp_path / "executed"
    module = kind()
    module.path = str(trace)
    with pytest.raises(FileFormatError, match=r"'code/__torch__/test_hostile_models.py' uses '\w+', which no plain"):
        load_model(scripted(module, tmp_path / "net.pt"), input_size=8)
    assert not trace.exists() and "\x1b" not in capfd.readouterr().out


ANSWER = """
import sys
from advsearch.cli.main import main
from advsearch.trust import foreign_code
foreign_code.LONGEST = 40
sys.exit(main(["labels", "mug", "--model", sys.argv[1]]))
"""


def exported_program(module: nn.Module, path: Path) -> Path:
    torch.export.save(torch.export.export(module.eval(), (torch.rand(1, 3, 8, 8),)), path)
    return path


@pytest.mark.medium
@pytest.mark.parametrize(
    ("module", "save"),
    [
        (NeverEnds(), scripted),
        (NeverEndsLoading(), scripted),
        pytest.param(SumsForYears(), exported_program, marks=pytest.mark.slow),
    ],
    ids=["loop", "loop while loading", "sum"],
)
def test_a_model_without_an_end_ends_with_one_sentence(
    module: nn.Module, save: Callable[[nn.Module, Path], Path], tmp_path: Path
) -> None:
    path = save(module, tmp_path / "net.pt2")
    command = [sys.executable, "-c", ANSWER, str(path)]
    environment = {**os.environ, "ADVSEARCH_LIMITS": "0.03"}  # 1 second
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=False)
    said = [line for line in done.stderr.splitlines() if line.startswith("advsearch: error")]
    assert done.returncode == 2 and len(said) == 1, done.stderr
    assert "no answer within 1 seconds; if you trust it, ADVSEARCH_LIMITS=10 in the environment" in said[0]


@pytest.mark.parametrize("text", ["getattr(torch, '\\163ave')", "x = '\\033[2J'", "torch.classes.other.X()"])
def test_torchscript_hides_nothing(text: str, script: Path, tmp_path: Path) -> None:
    name = "code/__torch__/test_hostile_models.py"
    code = member(script, name).replace(b"return", f"y = {text}\n    return".encode())
    with pytest.raises(FileFormatError, match=r"hidden characters|native classes"):
        load_model(repacked(script, tmp_path / "net.pt", {name: code}), input_size=8)


def test_a_tensor_is_as_large_as_torchscript_states(script: Path, tmp_path: Path) -> None:
    """torch reads past the end of the memory of one that is smaller."""
    data = member(script, "/data.pkl").replace(b"K\x24tQ", b"J\x00\x00\x00\x40tQ")
    data = data.replace(b"K\x03K\x0ct", b"J\x00\x00\x00\x04K\x0ct")
    with pytest.raises(FileFormatError, match="'data/0' has 144 bytes, but should hold 1,073,741,824 numbers"):
        load_model(repacked(script, tmp_path / "net.pt", {"data.pkl": data}), input_size=8)


def test_nested_pickles_of_torchscript_are_refused(script: Path, tmp_path: Path) -> None:
    """torch follows them until the stack is full, and the process ends."""
    deep = b"\x80\x02(" + b"]" * 300_000 + b"a" * 299_999 + b"t."
    with pytest.raises(FileFormatError, match=r"'constants.pkl' is nested deeper than 200"):
        load_model(repacked(script, tmp_path / "net.pt", {"constants.pkl": deep}), input_size=8)


def test_a_part_that_a_pickle_names_many_times_is_looked_at_once() -> None:
    wide: list[Any] = []
    for _ in range(30):
        wide = [wide] * 9  # in all 9**30 parts, if each is counted as often as it stands there
    with zipfile.ZipFile(io.BytesIO(), "w") as empty:
        archives._check_values(archives.Archive(Path("net.pt"), empty, {}), "constants.pkl", wide)


def test_pickles_of_torchscript_make_nothing(script: Path, tmp_path: Path) -> None:
    trace = tmp_path / "executed"
    data = b"\x80\x02(cos\nmkdir\nX" + len(str(trace)).to_bytes(4, "little") + str(trace).encode() + b"\x85Rt."
    with pytest.raises(FileFormatError, match="cannot be read as TorchScript"):
        load_model(repacked(script, tmp_path / "net.pt", {"constants.pkl": data}), input_size=8)
    assert not trace.exists()


@pytest.mark.parametrize("name", ["data.pkl", "code/__torch__/test_hostile_models.py"])
def test_damaged_torchscript_is_refused(name: str, script: Path, tmp_path: Path) -> None:
    content = member(script, f"/{name}")
    for damaged in (content[: len(content) // 2], bytes(100), b"\xff" * 50):
        with pytest.raises(FileFormatError):
            load_model(repacked(script, tmp_path / "net.pt", {name: damaged}), input_size=8)


def test_torchscript_that_swells_is_refused(script: Path, tmp_path: Path) -> None:
    path = repacked(script, tmp_path / "net.pt", {"extra/zeros": bytes(64 << 20)}, zipfile.ZIP_DEFLATED)
    with pytest.raises(FileFormatError, match="unpacks to at most 20 times its size"):
        load_model(path, input_size=8)


def test_pipes_and_devices_are_no_models(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.pt2")
    for path in (tmp_path / "pipe.pt2", Path("/dev/zero")):
        with pytest.raises(FileFormatError, match=r"expected a model file, got a (pipe|device)"):
            load_model(path)


@pytest.mark.parametrize("length", [0, 1 << 20, 1 << 62])
def test_safetensors_of_impossible_headers(length: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "hostile_weights.py").write_text("from torch import nn\nbuild = lambda: nn.Linear(2, 2)\n")
    path = tmp_path / "w.safetensors"
    path.write_bytes(length.to_bytes(8, "little") + b'{"weight":' * 10_000)
    with pytest.raises(FileFormatError, match="expected a complete safetensors file"):
        load_model(f"hostile_weights:build@{path}")
    with pytest.raises(FileFormatError, match="expected weights, got a device"):
        load_model("hostile_weights:build@/dev/zero")
