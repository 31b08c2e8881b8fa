"""One self-contained HTML page for a run: numbers, figures, videos and tables in a single file that needs no network.

Parts are made by the functions below; a plain string is a paragraph. Everything is escaped except what these functions
themselves write, so a name or an error message can hold any character.
"""
from __future__ import annotations

import base64
import inspect
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from .errors import PdkitError
from .files import atomic_file
from .plots import Picture
from .video import video_tag

CSS = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fafafa;
  max-width: 62rem; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.6rem; margin: .5rem 0 1rem; } h2 { font-size: 1.15rem; margin: 0 0 .6rem; }
section { background: #fff; border: 1px solid #e3e3e3; border-radius: 8px; padding: 1rem; margin: 0 0 1rem; }
img, video { max-width: 100%; height: auto; display: block; margin: .4rem auto; }
figure { margin: .6rem 0; } figcaption { color: #555; font-size: .9rem; }
.numbers { display: grid; grid-template-columns: repeat(auto-fit, minmax(10rem, 1fr)); gap: .7rem; }
.number { border-left: 4px solid #1f6fb4; padding: .1rem .7rem; }
.number b { font-size: 1.6rem; display: block; line-height: 1.2; } .number small { color: #555; display: block; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: .88rem; }
th, td { text-align: left; padding: .25rem .8rem .25rem 0; border-bottom: 1px solid #eee; vertical-align: top; }
td { overflow-wrap: anywhere; }
pre { background: #f3f3f3; padding: .7rem; border-radius: 6px; overflow-x: auto; font-size: .85rem; }
"""


PAGE = """<!doctype html>
<html lang="en">
<head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{css}</style></head>
<body><h1>{title}</h1>
{body}
</body></html>
"""


class Html(str):
    """Markup made here: not escaped again."""


@dataclass(frozen=True)
class Section:
    """A box of the page: a title and its parts, in order."""

    title: str
    parts: Sequence[str]


def numbers(items: Sequence[tuple[str, str, str]]) -> Html:
    """Headline numbers: (value, what it is, a remark) each."""
    cells = "".join(f'<div class="number"><b>{escape(value)}</b>{escape(what)}<small>{escape(remark)}</small></div>'
                    for value, what, remark in items)
    return Html(f'<div class="numbers">{cells}</div>')


def figure(picture: Picture | str | Path, caption: str = "") -> Html:
    """A figure, or a PNG file. Raises PdkitError when the file is missing or no PNG."""
    data = picture.png(dpi=130) if isinstance(picture, Picture) else _read(picture)
    if not data.startswith(b"\x89PNG"):
        raise PdkitError(f"{picture} is not a PNG picture.")
    source = base64.b64encode(data).decode()
    return Html(f'<figure><img alt="{escape(caption, quote=True)}" src="data:image/png;base64,{source}">'
                f"<figcaption>{escape(caption)}</figcaption></figure>")


def video(path: str | Path, caption: str = "") -> Html:
    """An MP4 file, its bytes inside the page."""
    _read(path)
    return Html(f"<figure>{video_tag(path, caption)}<figcaption>{escape(caption)}</figcaption></figure>")


def table(rows: Mapping[str, Any] | Sequence[Mapping[str, Any]]) -> Html:
    """A mapping as two columns, or rows (mappings with the same keys) under their names."""
    if isinstance(rows, Mapping):
        body = "".join(f"<tr><th>{escape(str(k))}</th><td>{escape(_text(v))}</td></tr>" for k, v in rows.items())
        return Html(f'<div class="scroll"><table>{body}</table></div>')
    head = "".join(f"<th>{escape(str(name))}</th>" for name in (rows[0] if rows else ()))
    body = "".join("<tr>" + "".join(f"<td>{escape(_text(v))}</td>" for v in row.values()) + "</tr>" for row in rows)
    return Html(f'<div class="scroll"><table><tr>{head}</tr>{body}</table></div>')


def details(title: str, *parts: Html) -> Html:
    """Parts that are folded away until the title is clicked."""
    return Html(f"<details><summary>{escape(title)}</summary>{''.join(parts)}</details>")


def source(*objects: Any):
    """Functions and classes of the library as a notebook shows code: the lines that matter, never a stale copy."""
    from IPython.display import Markdown

    parts = (textwrap.dedent(inspect.getsource(each)) for each in objects)
    return Markdown("```python\n" + "\n".join(parts) + "```")


def code(text: str) -> Html:
    """Text in a fixed-width box: a command."""
    return Html(f"<pre>{escape(text)}</pre>")


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{k} {_text(v)}" for k, v in value.items())
    return str(value)


def _read(path: str | Path) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise PdkitError(f"Cannot put {path} into the page: {error.strerror}.") from None


def write_page(path: str | Path, title: str, sections: Sequence[Section]) -> Path:
    """Write the page to `path` (.html), atomically; a reader sees the old one or the new one."""
    body = []
    for section in sections:
        parts = "\n".join(part if isinstance(part, Html) else f"<p>{escape(part)}</p>" for part in section.parts)
        body.append(f"<section><h2>{escape(section.title)}</h2>\n{parts}</section>")
    title = escape(title)
    with atomic_file(path) as temporary:
        temporary.write_text(PAGE.format(title=title, css=CSS, body="\n".join(body)), encoding="utf-8")
    return Path(path)
