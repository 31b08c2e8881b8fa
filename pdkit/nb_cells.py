"""Reading a notebook without running it: its `parameters` cell, and the conventions that every lesson keeps."""
from __future__ import annotations

import ast
import hashlib
import io
import json
import re
import tokenize
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nbformat

from .errors import PdkitError, unknown

PROFILES = ("smoke", "lesson", "paper")
REQUIRED = ("profile", "out")  # parameters that every notebook has
MAX_CELLS, MAX_LINES = 35, 40
ONLY = re.compile(r"(\w+ )?or (\w+)( ?[,:;(]|$)")  # how the comment of a `task` begins that can only be one of the tasks which it names
SOME = "at least one"  # what the comment of a list says that may not be empty
KINDS = {kind.__name__: kind for kind in (bool, int, float, str, list, dict)}


@dataclass(frozen=True)
class Parameter:
    """One line of a notebook's `parameters` cell: `alpha = 0.1  # residual bound`."""

    name: str
    default: Any
    kind: type
    optional: bool  # None is allowed
    help: str


def read_notebook(path: Path) -> nbformat.NotebookNode:
    """The notebook at `path`, format 4. Raises PdkitError when it is missing or no notebook."""
    try:
        notebook = nbformat.read(path, as_version=4)
        nbformat.validate(notebook)
    except OSError as error:
        raise PdkitError(f"Cannot read the notebook {path}: {error.strerror}.") from None
    except Exception as error:  # nbformat raises half a dozen kinds, JSON and schema errors among them
        reason = str(error).splitlines()[0]
        raise PdkitError(f"{path} is not a readable notebook ({reason}); it may be truncated or foreign.") from None
    return notebook


def code_cells(notebook: nbformat.NotebookNode) -> list[nbformat.NotebookNode]:
    """The code cells, in order."""
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def notebook_checksum(path: Path) -> str:
    """Of what a notebook's code cells do, without comments and blanks, and without the parameters cell, whose values are told apart."""
    def meant(source: str) -> str:
        try:
            return ast.dump(ast.parse(source))
        except SyntaxError:  # a foreign one with magics
            return source

    cells = [meant(cell.source) for cell in code_cells(read_notebook(path)) if not is_parameters(cell)]
    return hashlib.sha256("\n".join(cells).encode()).hexdigest()


def is_parameters(cell: nbformat.NotebookNode) -> bool:
    """Whether this is the cell after which papermill injects the given values."""
    return "parameters" in cell.metadata.get("tags", [])


def parameters_of(path: Path) -> dict[str, Parameter]:
    """The parameters that the notebook at `path` takes, in order. Raises PdkitError when the cell breaks the rules."""
    cells = [cell for cell in code_cells(read_notebook(path)) if is_parameters(cell)]
    if len(cells) != 1:
        raise PdkitError(f"{path.name} must have exactly one code cell tagged `parameters`, and has {len(cells)}.")
    try:
        return parse_parameters(cells[0].source)
    except (SyntaxError, ValueError) as error:
        raise PdkitError(f"The parameters cell of {path.name} is wrong: {error}.") from None


def parse_parameters(source: str) -> dict[str, Parameter]:
    """`name = literal  # help` lines as Parameters. Raises ValueError or SyntaxError that names the offender."""
    comments = _comments(source)
    found: dict[str, Parameter] = {}
    for node in ast.parse(source).body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None or len(targets) != 1 \
                or not isinstance(targets[0], ast.Name):
            raise ValueError(f"line {node.lineno} is not `name = literal`")
        name = targets[0].id
        if node.lineno != node.end_lineno:
            raise ValueError(f"{name} takes more than one line, which papermill does not read")
        if name in found:
            raise ValueError(f"{name} is set twice")
        try:
            default = ast.literal_eval(node.value)
        except ValueError:
            raise ValueError(f"the value of {name} is not a literal (derive it in the next cell)") from None
        kind, optional = _kind(name, default, getattr(node, "annotation", None))
        found[name] = Parameter(name, default, kind, optional, comments.get(node.lineno, ""))
    return found


def _comments(source: str) -> dict[int, str]:
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    return {token.start[0]: token.string.lstrip("# ") for token in tokens if token.type == tokenize.COMMENT}


def _kind(name: str, default: Any, annotation: ast.expr | None) -> tuple[type, bool]:
    """The type of a parameter and whether None is allowed, from its annotation or else from its default."""
    if annotation is None:
        if type(default) not in KINDS.values():
            raise ValueError(f"{name} needs a type: write `{name}: Optional[int] = None` (or float, str, ...)")
        return type(default), False
    text = ast.unparse(annotation)
    optional = text.startswith("Optional[")
    kind = KINDS.get(text.removeprefix("Optional[").removesuffix("]") if optional else text)
    if kind is None:
        raise ValueError(f"the type of {name} must be one of {', '.join(KINDS)}, or Optional[one of them]")
    if not (default is None and optional) and not isinstance(default, kind):
        raise ValueError(f"the default of {name} is not of its type {text}")
    return kind, optional


def parse_assignment(text: str) -> tuple[str, str]:
    """`alpha=0.1` as ("alpha", "0.1"). Raises PdkitError."""
    name, equals, value = text.partition("=")
    if not equals or not name.strip().isidentifier():
        raise PdkitError(f"{text!r} is not name=value, as in `-p alpha=0.1`.")
    return name.strip(), value.strip()


def from_text(text: str, parameter: Parameter) -> Any:
    """What the user typed, as JSON or a Python literal; as it stands where the parameter is a string."""
    for read in (json.loads, ast.literal_eval):
        try:
            value = read(text)
        except (ValueError, SyntaxError):
            continue
        if parameter.kind is not str or isinstance(value, str) or (value is None and parameter.optional):
            return value
    return text


def checked(notebook: str, known: dict[str, Parameter], given: dict[str, Any]) -> dict[str, Any]:
    """`given` as JSON types, each checked against the parameters cell. Raises PdkitError: papermill would only warn."""
    values = {}
    for name, value in given.items():
        if name not in known:
            raise unknown(f"parameter of {notebook}", name, known)
        values[name] = _fit(_plain(value), known[name])
    if values.get("profile", PROFILES[0]) not in PROFILES:
        raise unknown("profile", values["profile"], PROFILES)
    if "task" in values and (tasks := _tasks(known["task"])) and values["task"] not in tasks:
        raise unknown(f"task of {notebook}", values["task"], tasks)
    return values


def _tasks(parameter: Parameter) -> set[str]:
    """The tasks that a notebook has by the comment of its `task` ("or StackCube, the paper's"); empty where that names no second one so:
    then it may be any, also one that the notebook itself adds."""
    from .tasks import TASKS

    begins = ONLY.match(parameter.help)
    if not begins or begins[2] not in TASKS:
        return set()
    return {parameter.default, *(set(re.findall(r"\w+", parameter.help)) & set(TASKS))}


def _plain(value: Any) -> Any:
    """numpy numbers and arrays, tuples and paths as the JSON types that papermill can inject."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    return value


def _fit(value: Any, parameter: Parameter) -> Any:
    if value is None and parameter.optional:
        return None
    if parameter.kind is float and type(value) is int:
        return float(value)
    if type(value) is not parameter.kind:  # exact: True is no int here
        wanted = parameter.kind.__name__ + (" or None" if parameter.optional else "")
        raise PdkitError(f"Parameter {parameter.name} must be {wanted}, as its default {parameter.default!r} is; "
                         f"got {value!r}.")
    if parameter.kind is list and not value and SOME in parameter.help:
        raise PdkitError(f"Parameter {parameter.name} takes {SOME} entry, such as {parameter.default!r}.")
    kinds = {type(item) for item in parameter.default} if parameter.kind is list and parameter.default else set()
    if len(kinds) == 1:
        item_kind = kinds.pop()
        one = Parameter(f"{parameter.name} (each entry)", parameter.default[0], item_kind, False, "")
        return [_fit(item, one) for item in value]
    return value


def check_notebook(path: str | Path) -> list[str]:
    """What breaks the notebook conventions at `path`, one sentence each; empty when nothing does."""
    path = Path(path)
    try:
        notebook = read_notebook(path)
    except PdkitError as error:
        return [str(error)]
    cells = code_cells(notebook)
    found = []
    if len(notebook.cells) > MAX_CELLS:
        found.append(f"It has {len(notebook.cells)} cells, more than {MAX_CELLS}.")
    for number, cell in enumerate(notebook.cells, 1):
        found += [f"Cell {number} {problem}." for problem in _cell_problems(cell)]
    if not cells or not is_parameters(cells[0]):
        found.append("Its first code cell is not tagged `parameters`.")
    try:
        known = parameters_of(path)
        found += [f"Its parameters cell lacks `{name}`." for name in REQUIRED if name not in known]
        found += [f"Parameter {name} has no comment that says what it is." for name, p in known.items() if not p.help]
    except PdkitError as error:
        found.append(str(error))
    if not cells or not _calls_finish(cells[-1].source):
        found.append("Its last code cell does not call `nb.finish(result, out)`.")
    return found


def _cell_problems(cell: nbformat.NotebookNode) -> list[str]:
    problems = []
    if len(cell.source.splitlines()) > MAX_LINES:
        problems.append(f"has more than {MAX_LINES} lines")
    if "raises-exception" in cell.metadata.get("tags", []):
        problems.append("is tagged raises-exception, which papermill does not honour")
    if cell.cell_type != "code":
        return problems
    if cell.outputs or cell.execution_count is not None:
        problems.append("holds outputs; clear them before saving")
    if _shell_lines(cell.source):
        problems.append("runs a shell or installs packages; that belongs to the set-up")
    return problems


def _shell_lines(source: str) -> bool:
    from IPython.core.inputtransformer2 import TransformerManager

    code = TransformerManager().transform_cell(source)
    magics = tuple(f"get_ipython().run_{kind}_magic('{name}'" for kind in ("line", "cell")
                   for name in ("pip", "conda", "bash", "sh", "system", "sx", "script"))
    return any(call in code for call in ("get_ipython().system(", "get_ipython().getoutput(", *magics))


def _calls_finish(source: str) -> bool:
    try:
        tree = ast.parse(source)
    except SyntaxError:
        return False
    calls = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call))
    return any(isinstance(call, ast.Attribute) and call.attr == "finish" for call in calls)
