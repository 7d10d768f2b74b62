"""Checkpoints of a long computation: what it writes so that it can go on after a kill, each with a digest.

They lie in a run's folder (`scb.runs`), under checkpoints/.
"""

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp
from rich.console import Console

from scb import processes
from scb.artefacts import arrays_digest
from scb.errors import UserError, first_line

MARGIN = 2**16  # bytes that a checkpoint takes beside its arrays, and more


class Checkpoints:
    """Orbax checkpoints of a pytree of arrays, each with a digest, restored newest first.

    A checkpoint that cannot be read, or whose digest does not fit (cut in half, altered), is removed where one
    before it can be read, which is taken, and the caller is told. Where none can, all stay, and it is an error:
    perhaps it is not they that are at fault, but other versions of packages.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = (folder / "checkpoints").resolve()
        self._manager = self._open()

    def _open(self) -> ocp.CheckpointManager:
        # Of several processes one writes, and need not wait for the others.
        here = jax.process_index()
        alone = ocp.options.MultiprocessingOptions(primary_host=here, active_processes={here})
        options = ocp.CheckpointManagerOptions(
            max_to_keep=3, create=False, multiprocessing_options=alone
        )
        self.folder.mkdir(parents=True, exist_ok=True)
        return ocp.CheckpointManager(self.folder, options=options)

    def save(self, step: int, state: Any) -> None:
        """Writes `state` and waits until it is on disk; a UserError where it cannot be written."""
        leaves = _leaves(state)
        items = ocp.args.Composite(
            state=ocp.args.StandardSave(leaves),
            digest=ocp.args.JsonSave({"sha256": arrays_digest(leaves)}),
        )
        try:
            self._find_room(sum(leaf.nbytes for leaf in leaves.values()))
            self._manager.save(step, args=items)
            self._manager.wait_until_finished()
        # Orbax and tensorstore raise many kinds where a disk is full or a folder is gone.
        except Exception as error:
            raise UserError(
                f"checkpoint {step} could not be written to {self.folder} ({_said(error)}): the one before it is "
                "there; make room, and go on with --resume."
            ) from error

    def _find_room(self, size: int) -> None:
        """An OSError where there is none: from Orbax's threads a full disk brings hundreds of lines."""
        trial = self.folder / ".room"
        try:
            trial.write_bytes(bytes(2 * size + MARGIN))
        finally:
            trial.unlink(missing_ok=True)

    def restore(self, template: Any) -> tuple[int, Any, list[int]]:
        """(step, state, steps of unreadable newer checkpoints); step 0 and the template where there is none.

        Raises:
          UserError: there are checkpoints, and none can be read.
        """
        expected = _leaves(template)
        damaged: list[int] = []
        why = "altered"
        for step in sorted(self._manager.all_steps(), reverse=True):
            try:
                restored = self._manager.restore(
                    step,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardRestore(expected), digest=ocp.args.JsonRestore()
                    ),
                )
                intact = arrays_digest(restored["state"]) == restored["digest"]["sha256"]
                state = _from_leaves(template, restored["state"])
            # Orbax and tensorstore raise many kinds for a file that is cut or altered.
            except Exception as error:
                intact, why = False, _said(error)
            if intact:
                break
            damaged.append(step)
        else:
            step, state = 0, template
            if damaged:
                raise UserError(
                    f"no checkpoint in {self.folder} can be read ({why}): resume with the versions of packages that "
                    "wrote them, or remove that folder to start again at generation 0."
                )
        self._discard(damaged)
        return step, state, damaged

    def _discard(self, steps: list[int]) -> None:
        # Orbax refuses to save a step that exists, so a damaged one must make room for its
        # repetition.
        for step in steps:
            shutil.rmtree(self.folder / str(step), ignore_errors=True)
        if steps:
            self._manager.close()
            self._manager = self._open()

    def close(self) -> None:
        self._manager.close()


def continued(
    folder: Path | None, template: Any, console: Console
) -> tuple[Checkpoints | None, int, Any]:
    """(checkpoints, step, state) of a search, in all of its processes: the newest state in its folder, and its step.

    The first process alone has checkpoints, and says what was damaged. Without a folder, or with nothing in it, step
    0 and the template.
    """
    if folder is None:
        return None, 0, template
    checkpoints, step, state = None, 0, template
    if processes.first():
        checkpoints = Checkpoints(folder)
        step, state, damaged = checkpoints.restore(template)
        for number in damaged:
            console.print(
                f"checkpoint {number} is damaged: resuming from checkpoint {step} before it."
            )
    return checkpoints, processes.told(step), processes.agreed(state)


def _said(error: Exception) -> str:
    return first_line(error)[:200]


def _leaves(tree: Any) -> dict[str, np.ndarray]:
    leaves = jax.tree.leaves(jax.device_get(tree))
    return {f"leaf_{index:04d}": np.asarray(leaf) for index, leaf in enumerate(leaves)}


def _from_leaves(template: Any, leaves: Mapping[str, Any]) -> Any:
    treedef = jax.tree.structure(template)
    return jax.tree.unflatten(treedef, [jax.numpy.asarray(leaves[name]) for name in sorted(leaves)])
