"""Models (.pt2, TorchScript, ONNX), label files and YAML with settings."""

import io
import json
import pickle
import warnings
import zipfile
from collections.abc import Callable
from functools import cache

import torch
from torch import Tensor, nn

from fuzz import onnx_files
from fuzz.case import Case, Maker, Random
from fuzz.mutations import NUMBERS, as_json, confused, damaged


class Tiny(nn.Module):
    """Logits of three classes."""

    def forward(self, x: Tensor) -> Tensor:
        return x.mean(dim=(2, 3)) * torch.tensor([1.0, 2.0, 3.0])


@cache
def archive(kind: str) -> bytes:
    """Return a small honest model file: "pt2" or "torchscript"."""
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if kind == "pt2":
            torch.export.save(torch.export.export(Tiny().eval(), (torch.rand(2, 3, 16, 16),)), buffer)
        else:
            torch.jit.save(torch.jit.trace(Tiny(), torch.rand(1, 3, 224, 224)), buffer)
    return buffer.getvalue()


class Planted:
    """What a pickle runs when it is opened."""

    def __reduce__(self) -> tuple[Callable[[str], object], tuple[str]]:
        import os

        return os.system, ("touch planted",)


def repacked(data: bytes, change: Callable[[str, bytes], bytes], extra: dict[str, bytes] | None = None) -> bytes:
    """Return a ZIP archive with changed entries, uncompressed as torch wants them, and more of them."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(buffer, "w") as new:
        for entry in old.infolist():
            new.writestr(zipfile.ZipInfo(entry.filename), change(entry.filename, old.read(entry)))
        for name, content in (extra or {}).items():
            new.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def model(random: Random) -> Case:
    """A damaged or hostile model file."""
    kind = random.choice(("pt2", "torchscript"))
    data = archive(kind)
    names = [name for name in zipfile.ZipFile(io.BytesIO(data)).namelist()]
    chosen = random.choice(names)
    root = names[0].split("/")[0]
    texts = [name for name in names if name.endswith(".json")]

    def in_one(change: Callable[[bytes], bytes], target: str = chosen) -> bytes:
        return repacked(data, lambda name, content: change(content) if name == target else content)

    kinds: dict[str, Callable[[], bytes]] = {
        "damaged": lambda: damaged(random, data)[1],
        f"{chosen} damaged": lambda: in_one(lambda content: damaged(random, content or b"\0")[1]),
        f"{chosen} empty": lambda: in_one(lambda content: b""),
        "a planted pickle": lambda: in_one(
            lambda content: pickle.dumps(Planted()), next((n for n in names if n.endswith(("data.pkl", ".pt"))), chosen)
        ),
        "a bomb": lambda: repacked(data, lambda _, content: content, {f"{root}/data/bomb": bytes(1 << 30)}),
        "a name above": lambda: repacked(data, lambda _, content: content, {"../planted": b"x"}),
        "a name twice": lambda: repacked(data, lambda _, content: content, {chosen: b"x"}),
        "a pickle": lambda: pickle.dumps(Planted()),
    }
    if texts:
        text = random.choice(texts)
        for k in range(6):
            kinds[f"{text} confused {k}"] = lambda: in_one(
                lambda content: as_json(confused(random, json.loads(content))), text
            )
        kinds["a planted expression"] = lambda: repacked(
            data,
            lambda name, content: content.replace(b'"as_int": 16', b'"as_expr": {"expr_str": "__import__(\'os\')"}'),
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the doubled name
        what = random.choice(sorted(kinds))
        content = kinds[what]()
    suffix = "pt2" if kind == "pt2" else "pt"
    return Case(f"model: {kind} {what}", "model", f"net.{suffix}", {f"net.{suffix}": content})


def onnx(random: Random) -> Case:
    """A damaged or hostile ONNX file, its weights in other files too."""
    honest = onnx_files.weighted(onnx_files.floats("w", [1.0, 2.0, 3.0]))
    places = "../outside/secret.bin link.bin folder/secret.bin pipe /dev/zero . net.onnx own.bin none.bin".split()
    places += ["/proc/self/environ", "*/_ORT_MEM_ADDR_/*", "own.bin\0x", ""]
    spot, place = random.choice(("", "-4", "9" * 19, "8", "x")), random.choice(places)
    length = random.choice((None, None, "12", "-1", "4", "9" * 19))

    def referring() -> bytes:
        said = "folder/" + place if place == "net.onnx" else place
        tensor = onnx_files.elsewhere("w", [3], said, spot or "0", length)
        return onnx_files.weighted(tensor, as_constant=random.random() < 0.5)

    def sized(*shape: int | str) -> bytes:
        return onnx_files.weighted(onnx_files.floats("w", [1.0, 2.0, 3.0]), shape=shape)

    kinds: dict[str, Callable[[], bytes]] = {
        "damaged": lambda: damaged(random, honest)[1],
        "noise": lambda: random.randbytes(3_000),
        "a pickle": lambda: pickle.dumps(Planted()),
        "an operator of nobody": lambda: onnx_files.classifier([onnx_files.node("Evil", ["m"], ["y"], domain="evil")]),
        "a tensor larger than said": lambda: onnx_files.weighted(onnx_files.floats("w", [1.0], [1 << 40, 1 << 40])),
        "a negative side": lambda: onnx_files.weighted(onnx_files.floats("w", [1.0] * 3, [-3])),
        "a huge constant": lambda: onnx_files.multiplied(1 << 21, 1),
        "a huge input": lambda: sized("N", 3, 1 << 30, 1 << 30),
        "a huge batch": lambda: sized(1 << 40, 3, 16, 16),
        "an empty input": lambda: sized(0, 3, 0, 0),
        "graphs in graphs": lambda: nested(2_000),
    }
    kinds |= {f"weights elsewhere {k}": referring for k in range(len(kinds))}
    what = random.choice(sorted(kinds))
    content = kinds[what]()
    what = f"weights in {place!r} from {spot!r}, {length}" if "elsewhere" in what else what
    files = {"net.onnx": content, "own.bin": bytes(64)}
    links = {"link.bin": "../outside/secret.bin", "folder": "../outside"}
    return Case(f"model: onnx {what}", "model", "net.onnx", files, links, pipes=("pipe",))


def nested(levels: int) -> bytes:
    """Return an ONNX file of conditions in conditions."""
    content = onnx_files.graph([], [], [], [onnx_files.value("y", ["N", 3])])
    for _ in range(levels):
        both = onnx_files.inner("then_branch", content), onnx_files.inner("else_branch", b"")
        content = onnx_files.graph([onnx_files.node("If", ["t"], ["y"], *both)], [], [], [])
    return onnx_files.model(content)


def labels(random: Random) -> Case:
    """A damaged or hostile label file."""
    names = ["coffee mug", "bowl", "teapot", "vase"]
    kinds: dict[str, Callable[[], bytes]] = {
        "text damaged": lambda: damaged(random, "\n".join(names).encode())[1],
        "json damaged": lambda: damaged(random, as_json(names))[1],
        "json confused": lambda: as_json(confused(random, names)),
        "json by number confused": lambda: as_json(confused(random, {str(k): name for k, name in enumerate(names)})),
        "json with numbers": lambda: b'{"0": "a", "' + random.choice(NUMBERS) + b'": "b"}',
        "nested": lambda: b"[" * 50_000 + b"]" * 50_000,
        "an integer of 6,000 digits": lambda: b"[" + b"9" * 6_000 + b"]",
        "two million lines": lambda: b"a\n" * 2_000_000,
        "escapes": lambda: b"\x1b]0;owned\x07\n\x1b[31mred\nmug\n",
    }
    what = random.choice(sorted(kinds))
    suffix = "json" if "json" in what or (what[0] in "na" and random.random() < 0.7) else "txt"
    return Case(f"labels: {what}", "labels", f"names.{suffix}", {f"names.{suffix}": kinds[what]()})


YAML = b"command: attack\nobject: mug\nlabel: mug\ncontrols:\n  texture: {}\n"
YAML += b"steps: 20\nset: {camera.azimuth: 30}\n"


def settings(random: Random) -> Case:
    """A damaged or hostile YAML file."""
    laughs = b"a: &a [x, x, x, x, x, x, x, x, x]\n" + b"".join(
        b"%c: &%c [%s]\n" % (k, k, b", ".join([b"*%c" % (k - 1)] * 9)) for k in b"bcdefghij"
    )
    kinds: dict[str, Callable[[], bytes]] = {
        "damaged": lambda: damaged(random, YAML)[1],
        "an odd number": lambda: YAML.replace(b"20", random.choice((*NUMBERS, b"0b_", b"0o9", b"1:61", b".inf", b"~"))),
        "a tag that runs": lambda: YAML + b'goal: !!python/object/apply:os.system ["touch planted"]\n',
        "aliases of aliases": lambda: laughs + YAML,
        "nested": lambda: YAML + b"set: " + b"[" * 5_000 + b"]" * 5_000,
        "itself as base": lambda: b"base: run.yaml\n" + YAML,
        "a pipe as base": lambda: b"base: pipe\n" + YAML,
        "a device as base": lambda: b"base: /dev/zero\n" + YAML,
        "a key that is a list": lambda: YAML + b"? [a, b]\n: 1\n",
        "a value that holds itself": lambda: YAML + b"set: &a {x: *a}\n",
        "escapes": lambda: YAML + b'"\\e]0;owned\\a": 1\n',
        "no mapping": lambda: random.choice((b"", b"1", b"[1]", b"text", b"null")),
        "another command": lambda: YAML.replace(b"attack", random.choice((b"none", b"[1]", b"{}", b"sweep", b"check"))),
        "confused": lambda: as_json(
            confused(random, {"command": "attack", "object": "mug", "steps": 20, "set": {"a": 1}})
        ),
    }
    what = random.choice(sorted(kinds))
    return Case(f"yaml: {what}", "settings", "run.yaml", {"run.yaml": kinds[what]()}, pipes=("pipe",))


MAKERS: tuple[Maker, ...] = (model, labels, settings, model, onnx)
