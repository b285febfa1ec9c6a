"""The loaders under test: what a command does with a file before it renders or asks a model anything."""

import os
import shutil
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path


def load_object(path: Path) -> None:
    """Read an object and put it into Mitsuba."""
    import advsearch

    advsearch.load_scene(path).renderer("texture", resolution=16)


def load_node(path: Path) -> None:
    """Read a glTF scene, with its first node as the object and the rest around it, and render it from every camera."""
    import advsearch
    from advsearch.scene.importing.scenes import list_node_names

    names = list_node_names(path)
    if names:
        spec = f"{path}#{names[0]}"
        scene = advsearch.load_scene(spec)
        for camera in (None, *scene.description.cameras):
            seen = scene if camera is None else advsearch.load_scene(spec, camera=camera)
            renderer = seen.renderer("pose", resolution=8, denoise="none")
            radiance = renderer.radiance(renderer.start, spp=1)
            if not radiance.isfinite().all():
                raise ArithmeticError(f"its picture from {camera or 'the orbit'} has pixels that are no numbers")


def load_mitsuba(path: Path) -> None:
    """Read a Mitsuba scene, with its first shape that can be one as the object, and put it into Mitsuba."""
    import advsearch
    from advsearch.scene.mitsuba_backend.scene_files import read_contents

    names = read_contents(path).objects
    if names:
        advsearch.load_scene(names[0], scene=path).renderer("pose", resolution=16)


def load_environment(path: Path) -> None:
    """Read an environment and put it into Mitsuba."""
    import advsearch

    advsearch.load_scene("book", path).renderer("texture", resolution=16)


def load_picture(path: Path) -> None:
    """Read a picture for the `patch` control."""
    import advsearch

    advsearch.load_scene("book").renderer({"patch": {"picture": str(path), "size": [0.1, 0.2]}}, resolution=16)


def load_rig(path: Path) -> None:
    """Read a scene that several cameras see; of a transforms.json its first two frames."""
    import advsearch

    advsearch.load_scene("book", camera=f"{path}#0,1" if path.suffix == ".json" else str(path))


def load_model(path: Path) -> None:
    """Read a model and ask it once; what is wrong with its answers names the model, so it is called as its file."""
    from advsearch.models import ModelWarning, load_model

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # ONNX has no gradient
        load_model(path, name=str(path))


def load_labels(path: Path) -> None:
    """Read the names of classes."""
    from advsearch.models.labels import read_labels

    read_labels(path)


def load_settings(path: Path) -> None:
    """Read a YAML file as `advsearch run` does."""
    from advsearch.cli.flags import read_command, read_file_config

    read_file_config(read_command(path), path, {})


def load_run(path: Path) -> None:
    """List a run folder, and read what it holds as `show` and `export` do."""
    import io

    from advsearch.cli.show import show_run
    from advsearch.runs.export import write_rows
    from advsearch.runs.listing import read_listed_run
    from advsearch.runs.store import NAME, Store

    read_listed_run(path.parent)
    with Store(path.parent / NAME, read_only=True) as store:
        write_rows(store, "json", None, io.BytesIO())
    show_run(str(path.parent), as_json=False)


QUESTIONS = (
    ("show", "{run}"),
    ("show", "{run}", "--json"),
    ("report", "{run}", "--evidence", "--out", "made/report"),
    ("view", "{run}", "--bundle", "made/site"),
)
EXPORTS = (("export", "{run}", "--out", "made/rows.csv"), ("export", "{run}", "--out", "made/rows.json"))
OF_SWEEPS = (
    ("export", "{run}", "--format", "3db", "--out", "made/3db"),
    ("compare", "{run}", "../honest/sweep", "--run", "made/compare", "--pictures", "2"),
    ("explain", "{run}", "--confirm", "0", "--pairs", "0", "--clusters", "0", "--run", "made/explain"),
)
ASKED = {
    "study": QUESTIONS,
    "attack": (*QUESTIONS, *EXPORTS),
    "detection": (*QUESTIONS, *EXPORTS),
    "sweep": (*QUESTIONS, *EXPORTS, *OF_SWEEPS),
}
"""What is asked of a whole run, by its kind in `fuzz.run_folders`."""

PAGES = (
    *("", "cover", "rows", "rows?after=5", "progress", "align/", "pictures/0000/3.jpg", "parts/a/report.html"),
    *("align/renderings/3", "align/renderings/clean", "align/renderings/adversarial"),
)
"""Of the dashboard, about a run."""


def load_whole_run(kind: str, path: Path) -> None:
    """Ask all that is asked of a run that somebody else made: the list, the commands that read it, the dashboard.

    Raises the first of the errors that are told, and an ArithmeticError for what is no error of the run.
    """
    from PIL import Image

    from advsearch.errors import InputError
    from advsearch.runs import listing

    run = path.parent
    warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the reader itself has a smaller limit
    fault = listing.read_listed_run(run).fault
    said = [fault] if fault else []
    Path("made").mkdir(exist_ok=True)
    try:
        for question in ASKED[kind]:
            said += _refusal([word.format(run=run) for word in question])
    finally:
        shutil.rmtree("made")
    said += _page_faults(run, compares=kind in ("sweep", "detection"))
    unexpected = [one for one in said if "a fault of advsearch" in one]
    if unexpected:
        raise ArithmeticError(unexpected[0])
    if said:
        raise InputError(said[0])


def _refusal(words: list[str]) -> list[str]:
    """What a command says that refuses what it is given."""
    import contextlib
    import io

    from advsearch.cli.main import main

    out, errors = io.TextIOWrapper(io.BytesIO(), "utf-8"), io.TextIOWrapper(io.BytesIO(), "utf-8")
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        status = main(words)
        errors.flush()
    text = errors.buffer.getvalue().decode()
    if status not in (0, 2):
        raise ArithmeticError(f"{words[0]} ended with {status}: {text[-200:]}")
    if not status or "and this run " in text:  # it has no picture or no row, which is no damage
        return []
    return [text.splitlines()[-1].removeprefix("advsearch: error: ")]


def _page_faults(run: Path, *, compares: bool) -> list[str]:
    """What the dashboard says of pages that it cannot make."""
    import socket
    from threading import Thread
    from urllib.parse import quote

    from advsearch.viewer.server import Dashboard

    said, server = [], Dashboard((run,))
    name = quote(os.fsencode(run.name), safe="")
    pages = ["/", *(f"/runs/{name}/{page}" for page in PAGES), *([f"/compare/?run={name}"] if compares else [])]
    for page in pages:
        own, other = socket.socketpair()
        answered: list[bytes] = []
        reader = Thread(target=lambda own=own, answered=answered: answered.append(own.makefile("rb").read()))
        reader.start()
        own.sendall(f"GET {page} HTTP/1.0\r\nHost: 127.0.0.1:{server.server_port}\r\n\r\n".encode())
        server.clients.serve_connection(other, ("127.0.0.1", 0))
        reader.join()
        own.close()
        head, _, body = answered[0].partition(b"\r\n\r\n")
        if b"Content-Security-Policy: " not in head:
            raise ArithmeticError(f"{page}: has no policy: {head[:100]!r}")
        if head.split(b" ")[1] not in (b"200", b"404"):
            said.append(body.decode().strip())
    server.server_close()
    return said


def load_answer(path: Path) -> None:
    """Read the answer of a run."""
    from advsearch.runs.summary import read_configuration

    read_configuration(path.parents[1])


def load_blend(path: Path) -> None:
    """Read a Blender file, where Blender says and writes what is beside it; no process is started."""
    import subprocess
    import sys
    import tempfile
    from unittest.mock import patch

    from advsearch.trust import programs

    def stand_in(command: list[str], **given: object) -> subprocess.CompletedProcess[str]:
        made, target = path.with_name("made.glb"), Path(command[-2])
        if made.exists():
            target.write_bytes(made.read_bytes())
        said = path.with_name("said").read_text("utf-8", "replace")
        return subprocess.CompletedProcess(command, 0 if made.exists() else 1, said, "")

    with (
        patch("advsearch.trust.programs.subprocess.run", stand_in),
        patch.dict(os.environ, {programs.BLENDER: sys.executable}),
        patch.object(tempfile, "tempdir", str(path.parents[1] / "runs")),
    ):
        load_object(path)


def load_threedb(path: Path) -> None:
    """Read a folder of 3DB as `import-3db` does."""
    from advsearch.questions.sweep.result import read_image
    from advsearch.runs.export import read_threedb

    for _, picture in read_threedb(path.parent):
        if picture is not None:
            read_image(picture)


LOADERS: dict[str, Callable[[Path], object]] = {
    "object": load_object,
    "node": load_node,
    "mitsuba": load_mitsuba,
    "environment": load_environment,
    "picture": load_picture,
    "rig": load_rig,
    "model": load_model,
    "labels": load_labels,
    "settings": load_settings,
    "run": load_run,
    **{f"whole {kind}": partial(load_whole_run, kind) for kind in ASKED},
    "answer": load_answer,
    "blend": load_blend,
    "3db": load_threedb,
}
"""Each gets the path of a case's main file, and returns or raises an `AdvsearchError`."""


def warm_up(loaders: Iterable[str]) -> None:
    """Import what the loaders need, so that the libraries are not counted as the first case's memory and time."""
    import advsearch

    if {"object", "node", "mitsuba", "blend", "environment", "picture"} & set(loaders):
        advsearch.load_scene("book").renderer("texture", resolution=16)
        from PIL import Image

        import advsearch.scene.importing.objects
        import advsearch.scene.library
        import advsearch.scene.mitsuba_backend.scene_files

        Image.init()
    for kind in ASKED:
        if f"whole {kind}" in loaders:
            load_whole_run(kind, Path("../outside") / kind / "run.yaml")
    if {"model", "labels"} & set(loaders):
        import torch.export.pt2_archive  # makes a folder for compiled code
        import torch.jit  # noqa: F401

        import advsearch.models

        advsearch.models.load_model("reference")
