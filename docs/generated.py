"""The parts of the pages that the program itself knows: stages, tables, settings, packages.

A part stands between two marks, ``<!-- name -->`` and ``<!-- end of name -->``. Tests hold the
pages against the functions here. To write all parts again:

    python docs/generated.py FOLDER      # that holds out/, made by the README's first command
"""

import ast
import contextlib
import inspect
import io
import json
import re
import runpy
import sys
from collections.abc import Callable, Iterable
from enum import StrEnum
from pathlib import Path
from typing import Literal, get_args, get_origin

import polars as pl
import pyarrow as pa
from pydantic.fields import FieldInfo

from epipole.flows import api
from epipole.schemas.contract import breaks, contract
from epipole.schemas.log_bounds import BOUNDS, TIME
from epipole.schemas.log_checks import CheckVerdict, LogCause, LogCheck
from epipole.schemas.rejects import (
    Found,
    FrameStatus,
    NameStatus,
    ObjectVerdict,
    Outcome,
    Reason,
)
from epipole.schemas.run_record import RUNS, RunState
from epipole.schemas.scene import (
    LensDeparture,
    Orbit,
    Pointing,
    Scene,
    SceneCamera,
    SceneDetection,
    SceneFaults,
    SceneSensor,
    SceneShell,
    SceneStates,
    SceneTargets,
)
from epipole.schemas.settings import Settings
from epipole.schemas.stages import Stage
from epipole.schemas.tables import TABLES

ROOT = Path(__file__).parents[1]
HOMES = ("schemas", "io", "tasks", "flows")

# The published tables, by the stage that makes them.
MADE_BY = {
    Stage.READ: ("checks",),
    Stage.IDENTIFY: ("frames", "stars", "detections"),
    Stage.CALIBRATE: ("calibrations",),
    Stage.TRACK: ("tracklets",),
    Stage.SOLVE: (
        "epochs",
        "associations",
        "pairs",
        "positions",
        "states",
    ),
    Stage.NAME: ("identifications",),
    Stage.PUBLISH: (
        "observations",
        "orbits",
        "sensor_errors",
        "objects",
        "sources",
        "nights",
        "rejects",
    ),
}

TUTORIAL = "docs/first_night.md"

SCENE_PARTS = (
    "scene", "sensors", "targets", "orbit", "orbit.shells", "pointing", "camera",
    "camera.departure", "detection", "states", "faults",
)  # fmt: skip


def stages() -> str:
    """Return the README's table of stages."""
    rows = []
    for stage in Stage:
        made = [f"[`{table}`](docs/tables.md#{table})" for table in MADE_BY.get(stage, ())]
        rows.append((f"[`{stage}`](tasks/{stage}/)", stage.sentence, ", ".join(made)))
    return _markdown(("stage", "what it does", "tables"), rows)


def tables() -> str:
    """Return the list of tables, with what a row of each is."""
    rows = [(f"[`{name}`](#{name})", _doc(schema)) for name, schema in TABLES.items()]
    return _markdown(("table", "contents"), rows)


def columns() -> str:
    """Return a section for each table: all its columns."""
    return "\n".join(_section(name, schema) for name, schema in TABLES.items())


_HEADING = ("column", "type", "unit", "frame", "null", "meaning")


def _section(name: str, schema: pa.Schema) -> str:
    rows = [_column(field) for field in schema]
    return f"### {name}\n\n{_doc(schema)}\n\n{_markdown(_HEADING, rows)}"


def _column(field: pa.Field) -> tuple[str, ...]:
    about = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    kind = str(field.type).replace("double", "float64").replace(", tz=UTC", ", UTC")
    null = "yes" if field.nullable else ""
    before = f" Nights made before it was there: `{about['before']}`." if "before" in about else ""
    return (
        f"`{field.name}`", kind, about.get("unit", ""), about.get("frame", ""), null,
        about["doc"] + before,
    )  # fmt: skip


def _doc(schema: pa.Schema) -> str:
    return schema.metadata[b"doc"].decode()


def runs() -> str:
    """Return the columns of the records of runs, and how a run ends."""
    rows = [_column(field) for field in RUNS]
    states = _words("state", RunState)
    return f"{_doc(RUNS)}\n\n{_markdown(_HEADING, rows)}\n{states}"


def reasons() -> str:
    """Return the reasons of `rejects`, with their stages."""
    rows = [(f"`{reason}`", str(reason.stage), reason.sentence) for reason in Reason]
    return _markdown(("reason", "stage", "meaning"), rows)


def bounds() -> str:
    """Return the bounds of every value in a log."""
    rows = []
    for kind, of_kind in BOUNDS.items():
        for b in of_kind:
            low, high = ("1972", "2100") if b is TIME else (f"{b.minimum:g}", f"{b.maximum:g}")
            reason = f"`{b.reason}`" if b.reason else ""
            rows.append((kind, f"`{b.field}`", low, high, b.unit, reason, b.why))
    head = ("message", "field", "minimum", "maximum", "unit", "reason", "why")
    return _markdown(head, rows)


def outcomes() -> str:
    """Return the outcomes of tracklets."""
    return _words("outcome", Outcome)


def checks() -> str:
    """Return what a log is checked for."""
    return _words("check", LogCheck)


def mistakes() -> str:
    """Return the mistakes that checks of a log name, with what to do."""
    rows = [(f"`{each}`", _plain(each.evidence), each.cure)
            for each in LogCause if each.verdict == CheckVerdict.WRONG]  # fmt: skip
    return _markdown(("cause", "evidence", "what to do"), rows)


def _plain(text: str) -> str:
    """Return a text without the numbers of one finding."""
    return re.sub(r"\{[^}]*\}", "...", text)


def statuses() -> str:
    """Return the statuses of frames without an attitude from stars."""
    return _words("status", FrameStatus)


def object_names() -> str:
    """Return what may be known of an object's name."""
    return _words("status", NameStatus)


def found() -> str:
    """Return how objects are found."""
    return _words("found", Found)


def verdicts() -> str:
    """Return the verdicts of objects."""
    return _words("verdict", ObjectVerdict)


def _words(heading: str, words: Iterable[StrEnum]) -> str:
    rows = [(f"`{word}`", word.sentence) for word in words]  # type: ignore[attr-defined]
    return _markdown((heading, "meaning"), rows)


def settings() -> str:
    """Return a section for each group of settings: names, defaults, bounds, meanings."""
    sections = []
    for name, field in Settings.model_fields.items():
        group = type(field.default)
        rows = [
            (
                f"`{key}`",
                _default(option.default),
                _bounds(option),
                (option.description or "") + _choices(option),
            )
            for key, option in group.model_fields.items()
        ]
        table = _markdown(("setting", "default", "bounds", "meaning"), rows)
        sections.append(f"## {name}\n\n{group.__doc__}\n\n{table}")
    return "\n".join(sections)


def scene() -> str:
    """Return a section for each part of a scene: names, defaults, meanings."""
    parts = (Scene, SceneSensor, SceneTargets, Orbit, SceneShell, Pointing, SceneCamera,
             LensDeparture, SceneDetection, SceneStates, SceneFaults)  # fmt: skip
    names = dict(zip(parts, SCENE_PARTS, strict=True))
    sections = []
    for group, heading in names.items():
        rows = []
        for key, option in group.model_fields.items():
            inner = type(option.default)
            default = f"see {names[inner]}" if inner in names else _default(option.default)
            default = "required" if option.is_required() else default
            rows.append((f"`{key}`", default, (option.description or "") + _choices(option)))
        table = _markdown(("field", "default", "meaning"), rows)
        doc = " ".join((group.__doc__ or "").split())
        sections.append(f"### {heading}\n\n{doc}\n\n{table}")
    return "\n".join(sections)


def _bounds(option: FieldInfo) -> str:
    """Return the least and the largest value that a setting may have."""
    bounds = {
        kind: f"{getattr(each, kind):,.10g}"
        for each in option.metadata
        for kind in ("gt", "ge", "lt", "le")
        if isinstance(getattr(each, kind, None), int | float)
    }
    words = {"gt": "above {}", "ge": "{}", "lt": "below {}", "le": "{}"}
    return " to ".join(words[kind].format(bounds[kind]) for kind in words if kind in bounds)


def _choices(option: FieldInfo) -> str:
    if get_origin(option.annotation) is not Literal:
        return ""
    return " One of " + ", ".join(f"`{name}`" for name in get_args(option.annotation)) + "."


def _default(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, tuple):
        return f"{len(value)} entries"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def public_names() -> str:
    """Return the functions for notebooks, each with the first line of its docstring."""
    rows = [
        (f"`{name}`", (inspect.getdoc(getattr(api, name)) or "").partition("\n")[0])
        for name in api.__all__
        if inspect.isfunction(getattr(api, name))
    ]
    return _markdown(("name", "what it does"), rows)


def rooms() -> str:
    """Return all packages, each with the first paragraph of its docstring."""
    rows = [
        (f"[`{folder}/`]({folder}/)", _first_paragraph(ROOT / folder / "__init__.py"))
        for folder in packages()
    ]
    return _markdown(("folder", "holds"), rows)


def packages() -> list[str]:
    """Return the folders of all packages, from the root of the repository."""
    files = [f for home in HOMES for f in sorted((ROOT / home).rglob("__init__.py"))]
    return [file.parent.relative_to(ROOT).as_posix() for file in files]


def _first_paragraph(module: Path) -> str:
    doc = ast.get_docstring(ast.parse(module.read_text())) or ""
    return " ".join(doc.partition("\n\n")[0].split())


def output(folder: Path) -> str:
    """Return what the README's query prints where `folder` holds out/."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pl.Config(tbl_width_chars=100):
        exec(code("README.md", "query", f"{folder}/out/"), {})
    return f"```\n{printed.getvalue()}```\n"


def orbit(folder: Path) -> str:
    """Return what the example's fit prints where `folder` holds out/."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        runpy.run_path(str(ROOT / "examples" / "fit_orbit.py"))["main"](f"{folder}/out")
    return f"```\n{printed.getvalue()}```\n"


def code(page: str, name: str, out: str) -> str:
    """Return the Python code of a page's part, which reads its dataset from `out`."""
    text = part((ROOT / page).read_text(), name)
    return text.split("```")[1].removeprefix("python\n").replace('"out/', f'"{out}')


def with_outputs(text: str, folder: Path) -> str:
    """Return a tutorial with what its Python code prints where `folder` holds out/.

    A block of Python and the block of text that follows it are code and output. All blocks are
    one program, in the page's order.
    """
    names: dict = {}

    def run(match: re.Match[str]) -> str:
        printed, source = io.StringIO(), match[1]
        source = source.replace('"out/', f'"{folder}/out/')
        source = source.replace('"night.png"', f'"{folder}/night.png"')
        with contextlib.redirect_stdout(printed), pl.Config(tbl_width_chars=100):
            exec(source, names)
        output = f"```text\n{printed.getvalue()}```\n" if match[2] else ""
        return f"```python\n{match[1]}```\n" + ("\n" if output else "") + output

    blocks = r"^```python\n(.*?)^```\n(?:\n(```text\n.*?^```\n))?"
    return re.sub(blocks, run, text, flags=re.DOTALL | re.MULTILINE)


# Each page's parts but those that need a dataset: `output` and `orbit`.
PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "README.md": {"stages": stages},
    "docs/tables.md": {
        "tables": tables,
        "columns": columns,
        "reasons": reasons,
        "outcomes": outcomes,
        "statuses": statuses,
        "names": object_names,
        "found": found,
        "verdicts": verdicts,
        "checks": checks,
        "runs": runs,
    },
    "docs/input.md": {"bounds": bounds, "mistakes": mistakes},
    "docs/settings.md": {"settings": settings},
    "docs/api.md": {"names": public_names},
    "docs/scenes.md": {"scene": scene},
    "CONTRIBUTING.md": {"packages": rooms},
}


def part(text: str, name: str) -> str:
    """Return what stands between a part's two marks.

    Raises
    ------
    ValueError
        Where the text has no such part.
    """
    match = re.search(rf"<!-- {name} -->\n(.*?)<!-- end of {name} -->", text, re.DOTALL)
    if match is None:
        raise ValueError(f"there is no part {name}")
    return match[1]


def with_part(text: str, name: str, content: str) -> str:
    """Return the text with another content between a part's two marks."""
    start, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
    return text.replace(f"{start}{part(text, name)}{end}", f"{start}{content}{end}")


CONTRACT = ROOT / "docs" / "tables.json"


def write_contract() -> None:
    """Write docs/tables.json again, unless that would break its readers."""
    after = contract()
    before = json.loads(CONTRACT.read_text()) if CONTRACT.exists() else {}
    for name, table in before.items():
        gone = ["the table is gone"] if name not in after else breaks(table, after[name])
        if told := list(gone):
            sys.exit(f"{name}: {'; '.join(told)}; raise its version, or change nothing of that")
    CONTRACT.write_text(json.dumps(after, indent=1) + "\n")


def write(folder: Path) -> None:
    """Write all parts of all pages again."""
    write_contract()
    for page, parts in PARTS.items():
        text = (ROOT / page).read_text()
        for name, content in parts.items():
            text = with_part(text, name, content())
        (ROOT / page).write_text(text)
    for page, name, made in (
        ("README.md", "output", output(folder)),
        ("docs/orbits.md", "orbit", orbit(folder)),
    ):
        (ROOT / page).write_text(with_part((ROOT / page).read_text(), name, made))
    (ROOT / TUTORIAL).write_text(with_outputs((ROOT / TUTORIAL).read_text(), folder))


def _markdown(heading: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    lines = [heading, ("---",) * len(heading), *rows]
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else Path.cwd())
