"""Hazards: a scene in the grid world, as the moves that touch it and the costs of entering each cell; ours.

    Scene, GridPath --hazards_of--> Hazards

A *cell* is forbidden if its centre touches something, because centres are what a policy commands; a *move* touches if
the straight line between the two centres does, so no move passes through a thin box. The distance of the tip from the
centre of its cell, and the size of the tool, belong into the scene's margin.

A policy keeps the scene that it was learnt in, with its costs, as `Surroundings`.
"""

from dataclasses import astuple, dataclass
from math import isfinite

import numpy as np

from skills.arrays import Flags, Floats, Ints
from skills.errors import BadSettings
from skills.fields import schema
from skills.gridworld.grid import MOVES, GridPath, GridWorld
from skills.gridworld.scene import Scene

STAY = 13  # the action that stays: (0, 0, 0), the middle one of the moves


@schema
@dataclass(frozen=True)
class SceneCosts:
    """Costs in addition to the rewards of Algorithm 1; the paper has none.

    Attributes:
        touch: Of touching, which ends the pass. More than a path of 90 states can earn, so no style is worth a touch.
        close: Of entering a cell whose centre touches, less with its clearance, down to 0 at `close_mm`.
        close_mm: Clearance from which on a cell costs nothing.
        deeper_per_mm: Of entering a cell, for each mm that it is deeper than all states of the demonstration, along
            the normal of the tissue.
    """

    touch: float = 100.0
    close: float = 0.1
    close_mm: float = 5.0
    deeper_per_mm: float = 0.01

    def __post_init__(self) -> None:
        costs = astuple(self)
        if not (all(map(isfinite, costs)) and min(costs) >= 0 and self.touch > 0 and self.close_mm > 0):
            raise BadSettings("Costs must be finite and 0 or more; `touch` and `close_mm` positive.", costs=costs)


@dataclass(frozen=True)
class Surroundings:
    """A scene, and the costs with which a policy is learnt in it."""

    scene: Scene
    costs: SceneCosts = SceneCosts()


@dataclass(frozen=True, eq=False)
class Hazards:
    """A scene on a grid.

    Attributes:
        touches: Whether the move by each action from each state touches, (n_states, 27); off the grid it stays.
        cost: Cost of entering each state, (n_states,).
        surroundings: The scene, and its costs.
    """

    touches: Flags
    cost: Floats
    surroundings: Surroundings

    @property
    def touch(self) -> float:
        """The cost of touching."""
        return self.surroundings.costs.touch

    @property
    def forbidden(self) -> Flags:
        """Whether the centre of each state's cell touches, (n_states,)."""
        return np.asarray(self.touches[:, STAY])


def hazards_of(scene: Scene, path: GridPath, frame: str, costs: SceneCosts | None = None) -> Hazards:
    """Return which moves of a path's grid touch a scene, and the cost of each state.

    Args:
        scene: The scene, in the frame of the path.
        path: The demonstrated path.
        frame: The frame of the path.
        costs: The costs; None for the defaults.

    Returns:
        The hazards.

    Raises:
        BadSettings: The scene is in another frame; or the demonstration itself touches it, and cannot be followed.
    """
    refuse_unfit(scene, path, frame)
    costs, grid = costs or SceneCosts(), path.grid
    states = np.arange(grid.n_states)
    centres = grid.centres_mm(states)
    touches = np.stack([touching(scene, grid, states, np.full(len(states), a)) for a in range(len(MOVES))], axis=1)
    cost = costs.close * (1 - scene.clearance_mm(centres) / costs.close_mm).clip(0)
    if scene.tissue is not None:
        below_mm = scene.tissue.above_mm(path.tip_mm).min() - scene.tissue.above_mm(centres)
        cost = cost + costs.deeper_per_mm * below_mm.clip(0)
    return Hazards(touches, np.asarray(cost), Surroundings(scene, costs))


def refuse_unfit(scene: Scene, path: GridPath, frame: str) -> None:
    """Refuse a scene in which a demonstration cannot be followed.

    Args:
        scene: The scene.
        path: The demonstrated path.
        frame: The frame of the path.

    Raises:
        BadSettings: The scene is in another frame, or the demonstration itself touches it.
    """
    if scene.frame != frame:
        raise BadSettings(
            f"The scene is in the frame '{scene.frame}', the demonstration in '{frame}'; give the scene in that frame."
        )
    bad = np.flatnonzero(scene.touches(path.tip_mm[:-1], path.tip_mm[1:]))
    if len(bad):
        x, y, z = path.tip_mm[bad[0]]
        raise BadSettings(
            f"The demonstration itself touches the scene in {len(bad)} of {len(path.states) - 1} moves, first from "
            f"({x:.1f}, {y:.1f}, {z:.1f}) mm; check the scene's frame and margin, or record the hand-off further away.",
            moves=len(bad),
        )


def touching(scene: Scene, grid: GridWorld, states: Ints, actions: Ints) -> Flags:
    """Return for each state and action whether the move touches a scene; off the grid it stays.

    Args:
        scene: The scene, in the frame of the grid.
        grid: The grid world.
        states: States, shape (N,).
        actions: The action in each, 0 to 26, shape (N,).

    Returns:
        Whether the straight line between the centres of the two cells comes within the scene's margin, shape (N,).
    """
    cells = grid.cells_of(states)
    after = cells + MOVES[actions]
    after = np.where(grid.holds(after)[:, None], after, cells)
    return scene.touches(grid.centres_of(cells), grid.centres_of(after))
