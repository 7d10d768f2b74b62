"""`lpo show`: what an objective does to an update, as a figure, in numbers, and as a page to move."""

from pathlib import Path

import tyro

from lpo.drift_figures import drift_and_gradient
from lpo.objectives import REFERENCES, load_apart, load_objective
from lpo.page import save_objective_page
from lpo.update_regions import REGIONS, analyze
from scb import interactive, plotting
from scb.console import console
from scb.errors import UserError
from scb.files import make_folder, write_json


def show_command(
    objective: tyro.conf.Positional[str],
    beside: tuple[str, ...] = REFERENCES,
    progress: float = 0.5,
    out: Path | None = None,
    html: bool = False,
) -> None:
    """Show what an objective does to an update: where it stops one, lets it go on, or turns it round.

    Args:
      objective: ppo, ppo-0.3, dpo, dpo-4-1.2, none, a zoo name, path.npz, or
        package.module:function of your own.
      beside: other objectives to show with it.
      progress: fraction of training done, from 0 to 1, for objectives that change with it.
      out: folder for show.png, show.json and show.html; runs/show/NAME where left out, of a run's objective.npz
        by the name of its folder.
      html: also write a page where advantage and ratio can be moved and the penalty turned (extra `html`).
    """
    if not 0.0 <= progress <= 1.0:
        raise UserError(f"--progress is {progress}: it is a fraction of training, from 0 to 1.")
    if html:
        interactive.plotly()  # before the work, not after it
    shown = load_objective(objective)
    objectives = load_apart([*(name for name in beside if name != objective), shown])
    folder = Path("runs") / "show" / shown.name if out is None else out
    make_folder(folder)
    found = [analyze(o, progress) for o in objectives]
    write_json(folder / "show.json", {"objectives": [analysis.as_dict() for analysis in found]})
    plotting.save(drift_and_gradient(objectives, (progress,)), folder / "show.png")
    if html:
        save_objective_page(folder / "show.html", objectives, progress)
    printer = console()
    for analysis in found:
        shares = ", ".join(
            f"{n} {analysis.fractions[n]:.0%}" for n in REGIONS if analysis.fractions[n] >= 0.005
        )
        printer.print(f"{analysis.objective}: {shares}")
    printer.print(f"written to {folder}", soft_wrap=True)
