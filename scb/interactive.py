"""Pages with figures that can be turned and moved: one HTML file each, which needs nothing else to be shown.

Plotly draws them (the extra `html`); its script, 5 MB, is part of each file.
"""

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

from scb.errors import needed_for
from scb.files import write_text

_STYLE = """
body { font-family: system-ui, sans-serif; max-width: 1180px; margin: 1.5rem auto; padding: 0 1rem; color: #222; }
h1 { font-size: 1.5rem; margin-bottom: 0.3rem; }
h2 { font-size: 1.1rem; margin: 1.6rem 0 0.2rem; }
p { line-height: 1.45; max-width: 46rem; margin: 0.3rem 0; }
code { background: #f2f2f2; padding: 0 0.2em; }
"""


def plotly() -> ModuleType:
    """`plotly.graph_objects`.

    Raises:
      UserError: it is not installed.
    """
    with needed_for("a page with figures to turn needs", "plotly", "html"):
        import plotly.graph_objects
    return plotly.graph_objects


def slider(label: str, steps: Sequence[tuple[str, Mapping[str, Any]]], active: int) -> Any:
    """One slider below a figure.

    Args:
      label: what it moves.
      steps: of each position its text, and what it restyles: {attribute: a value for each trace}.
      active: the position at first.
    """
    return {
        "active": active,
        "currentvalue": {"prefix": f"{label}: "},
        "pad": {"t": 40},
        "steps": [
            {"label": text, "method": "restyle", "args": [dict(change)]} for text, change in steps
        ],
    }


def save_page(path: Path, title: str, summary: str, figures: Mapping[str, tuple[str, Any]]) -> Path:
    """Writes one page.

    Args:
      path: of the file.
      title: its heading.
      summary: a sentence below it.
      figures: {heading: (what is to be seen and done, a Plotly figure)}, in this order.
    """
    parts = [f"<h1>{html.escape(title)}</h1>", f"<p>{html.escape(summary)}</p>"]
    for number, (heading, (text, figure)) in enumerate(figures.items()):
        figure.update_layout(template="plotly_white", font={"size": 13})
        body = figure.to_html(
            full_html=False,
            include_plotlyjs=number == 0,
            div_id=f"figure-{number}",
            config={"displaylogo": False, "responsive": True},
        )
        parts += [f"<h2>{html.escape(heading)}</h2>", f"<p>{html.escape(text)}</p>", body]
    head = (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>'
        f"{html.escape(title)}</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{_STYLE}</style></head><body>"
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "\n".join([head, *parts, "</body></html>", ""]))
    return path
