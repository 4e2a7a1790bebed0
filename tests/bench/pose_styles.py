"""Pose styles on hands left out: ours beside a straight line, the medoid, and movement primitives of libraries.

`SKILLS_TEST_BENCHMARKS` names the folder of the public pose data: CLFD, three tasks of nine demonstrations, and 50
needle regrasps of SurgicAI in a simulator, in its units. One demonstration after the other is left out, and its start
and goal pose are given to all alike. Position: mean Euclidean distance along the DTW alignment; orientation: mean angle
at equal phase. DMP and ProMP are those of movement_primitives, the mixtures of GMR and TP-GMM those of scikit-learn.
All but the straight line, the DMP and TP-GMM's positions learn from the demonstrations laid between start and goal.

`SKILLS_TEST_JIGSAWS` names the folder of two tasks of JIGSAWS. Of each trial the longest hand-off is taken that is
proposed for the left instrument; five of other surgeons, drawn by a seed, are shown for each.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from movement_primitives.dmp import CartesianDMP
from movement_primitives.promp import ProMP
from rich.table import Table
from scipy.spatial.transform import Rotation, Slerp

from skills.arrays import Floats
from skills.demonstration.demonstration import Demo, cut_demo
from skills.demonstration.segments import propose_segments
from skills.learning.evaluation import dtw
from skills.learning.pose_style import PHASES, PoseStyle, laid_rotations, laid_tip, learn_pose_style
from skills.quaternions import mean_rotation
from tests.bench.recognition import TASKS, recordings
from tests.bench.timing import best_s

if TYPE_CHECKING:
    from sklearn.mixture import GaussianMixture

Poses = tuple[Floats, Floats]  # positions, (PHASES, 3), and unit quaternions, (PHASES, 4)
Method = Callable[[list[Poses], Poses, Poses], Poses]  # demonstrations, their medoid, start and goal pose: a motion
PHASE = np.linspace(0.0, 1.0, PHASES)
ARM, COMBINED = "PSM_left", 5


def motions() -> dict[str, list[Poses]]:
    """Return the demonstrations of each set, resampled in time: CLFD in cm, SurgicAI in its own units."""
    folder = Path(os.environ["SKILLS_TEST_BENCHMARKS"])
    found = {}
    for name in ("bottle2shelf", "openbox", "platestandingtolying"):
        poses = np.load(folder / f"clfd_{name}.npy").astype(np.float64)
        found[name] = [_resampled(one[:, :3], Rotation.from_quat(one[:, [4, 5, 6, 3]])) for one in poses]
    with np.load(folder / "surgicai_regrasp.npz") as archive:
        episode, pose = archive["episode"], archive["observation"][:, :6].astype(np.float64)
    found["regrasp"] = [
        _resampled(pose[episode == one, :3], Rotation.from_euler("xyz", pose[episode == one, 3:]))
        for one in np.unique(episode)
    ]
    return found


def surgeons() -> dict[str, list[tuple[str, Poses]]]:
    """Return the hand-offs of each task of JIGSAWS with the letters of their surgeons, resampled in time, in mm."""
    found: dict[str, list[tuple[str, Poses]]] = {task: [] for task in TASKS.values()}
    for task, surgeon, _, recording in recordings():
        longest = max(propose_segments(recording, ARM), key=lambda one: one.end_s - one.start_s, default=None)
        if longest is None:
            continue
        demo = cut_demo(recording, arm=ARM, start_s=longest.start_s, end_s=longest.end_s)
        assert demo.rotation_xyzw is not None, "every row has an orientation"
        found[task].append((surgeon, _resampled(demo.tip_mm, Rotation.from_quat(demo.rotation_xyzw))))
    return found


def drawn(users: Sequence[str], seed: int = 0) -> list[list[int]]:
    """Draw for each demonstration `COMBINED` of other surgeons."""
    rng = np.random.default_rng(seed)
    others = [[k for k, other in enumerate(users) if other != user] for user in users]
    return [sorted(rng.choice(one, COMBINED, replace=False).tolist()) for one in others]


def _resampled(tip: Floats, rotation: Rotation) -> Poses:
    at, places = np.linspace(0.0, 1.0, len(tip)), PHASE
    position = np.stack([np.interp(places, at, axis) for axis in tip.T], axis=1)
    return position, Slerp(at, rotation)(places).as_quat()


def demo_of(poses: Poses) -> Demo:
    """Return poses as a demonstration of ten seconds."""
    tip, rotation = poses
    return Demo("PSM1", "table", "world", 0.0, 10.0, 10.0 * PHASE, tip, rotation)


def errors(motion: Poses, shown: Poses) -> tuple[float, float]:
    """Return the mean distance along the DTW alignment, and the mean angle at equal phase in degrees."""
    pairs = dtw(motion[0], shown[0]).pairs
    apart = np.linalg.norm(motion[0][pairs[:, 0]] - shown[0][pairs[:, 1]], axis=1)
    turned = (Rotation.from_quat(motion[1]).inv() * Rotation.from_quat(shown[1])).magnitude()
    return float(apart.mean()), float(np.degrees(turned.mean()))


# ---- methods ---------------------------------------------------------------------------------------------------------


def style_of(shown: list[Poses]) -> PoseStyle:
    """Return the pose style of demonstrations."""
    return learn_pose_style([demo_of(one) for one in shown])


def ours(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """Ours."""
    path = style_of(shown).between(ends[0][0], ends[1][0], ends[0][-1], ends[1][-1])
    return path.tip_mm, path.rotation_xyzw


def alone(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """Ours, from the first demonstration alone."""
    return ours(shown[:1], middle, ends)


def straight(ends: Poses) -> Poses:
    """Return a straight line at constant speed, with slerp."""
    tip = ends[0][0] + PHASE[:, None] * (ends[0][-1] - ends[0][0])
    return tip, Slerp([0, 1], Rotation.from_quat(ends[1][[0, -1]]))(PHASE).as_quat()


def line(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """A straight line."""
    return straight(ends)


def medoid(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """The demonstration that is nearest to all others, where it was shown."""
    return middle


def laid(one: Poses, ends: Poses) -> Poses:
    """Return a demonstration laid between start and goal, as in `skills.learning.pose_style`."""
    return laid_tip(one[0], ends[0][[0, -1]]), laid_rotations(one[1][None], ends[1][[0, -1]])[0]


def laid_medoid(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """The medoid, laid."""
    return laid(middle, ends)


def mean(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """The mean at equal phase of all, laid."""
    tips, rotations = (np.stack(part) for part in zip(*(laid(one, ends) for one in shown), strict=True))
    return tips.mean(axis=0), mean_rotation(rotations, np.full(len(tips), 1 / len(tips)))


def dmp(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """A dynamic movement primitive of the medoid, with its start and goal replaced."""
    primitive = CartesianDMP(execution_time=1.0, dt=1 / (PHASES - 1), n_weights_per_dim=30)
    tip, rotation = middle
    primitive.imitate(PHASE, np.hstack([tip, rotation[:, [3, 0, 1, 2]]]))
    first, last = (np.concatenate([ends[0][k], ends[1][k][[3, 0, 1, 2]]]) for k in (0, -1))
    primitive.configure(start_y=first, goal_y=last)
    _, made = primitive.open_loop(run_t=1.0)
    return _resampled(made[:, :3], Rotation.from_quat(made[:, [4, 5, 6, 3]]))


def _residuals(shown: list[Poses], ends: Poses) -> tuple[Floats, Poses]:
    """Return the laid demonstrations as offsets and rotation vectors about the straight line, (K, PHASES, 6)."""
    base = straight(ends)
    turn = Rotation.from_quat(base[1]).inv()
    found = [laid(one, ends) for one in shown]
    return np.stack([np.hstack([p - base[0], (turn * Rotation.from_quat(q)).as_rotvec()]) for p, q in found]), base


def _added(base: Poses, residual: Floats) -> Poses:
    turned = Rotation.from_quat(base[1]) * Rotation.from_rotvec(residual[:, 3:])
    return base[0] + residual[:, :3], turned.as_quat()


def promp(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """A probabilistic movement primitive of all, laid, with ridge weights; its mean, since all begin and end alike."""
    values, base = _residuals(shown, ends)
    primitive = ProMP(n_dims=6, n_weights_per_dim=25)
    weights = np.stack([primitive.weights(PHASE, one, lmbda=1e-6).ravel() for one in values])
    primitive.from_weight_distribution(weights.mean(axis=0), np.cov(weights.T))
    return _added(base, primitive.mean_trajectory(PHASE))


def _given(mixture: "GaussianMixture", known: Floats, outputs: slice) -> tuple[Floats, Floats]:
    """Return mean (T, D) and covariance (T, D, D) of the outputs of a mixture, given its first variable."""
    means, covariances = mixture.means_, mixture.covariances_
    chance = mixture.weights_ * np.exp(-0.5 * (known[:, None] - means[:, 0]) ** 2 / covariances[:, 0, 0])
    chance /= np.sqrt(covariances[:, 0, 0])
    chance /= chance.sum(axis=1, keepdims=True)
    slope = covariances[:, outputs, 0] / covariances[:, 0, 0][:, None]
    centres = means[:, outputs] + (known[:, None, None] - means[:, 0, None]) * slope
    rest = covariances[:, outputs, outputs] - slope[:, :, None] * covariances[:, 0, outputs][:, None, :]
    middle = np.einsum("tk,tkd->td", chance, centres)
    off = centres - middle[:, None]
    return middle, np.einsum("tk,kde->tde", chance, rest) + np.einsum("tk,tkd,tke->tde", chance, off, off)


def _mixture(data: Floats) -> "GaussianMixture":
    from sklearn.mixture import GaussianMixture  # slow to import, and tests import this module for other methods

    found = GaussianMixture(8, random_state=0, reg_covar=1e-4, n_init=2)
    # Begun at equal parts of the phase, as is usual for trajectories: k-means mixes beginning and end.
    part = np.minimum((data[:, 0] * 8).astype(int), 7)
    found.means_init = np.stack([data[part == k].mean(axis=0) for k in range(8)])
    return found.fit(data)


def gmr(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """Gaussian mixture regression on the phase, of all, laid."""
    values, base = _residuals(shown, ends)
    scale = values.reshape(-1, 6).std(axis=0) + 1e-9
    data = np.hstack([np.tile(PHASE, len(values))[:, None], (values / scale).reshape(-1, 6)])
    return _added(base, _given(_mixture(data), PHASE, slice(1, 7))[0] * scale)


def tp_gmm(shown: list[Poses], middle: Poses, ends: Poses) -> Poses:
    """A mixture in the frames of start and goal, whose product at new frames is the motion; orientations as `gmr`."""

    def frames(one: Poses) -> tuple[Rotation, Floats]:
        return Rotation.from_quat(one[1][[0, -1]]), one[0][[0, -1]]

    scale = float(np.mean([one[0].std() for one in shown]))
    columns = []
    for one in shown:
        turns, places = frames(one)
        columns.append(np.hstack([turns[k].inv().apply(one[0] - places[k]) / scale for k in (0, 1)]))
    data = np.hstack([np.tile(PHASE, len(shown))[:, None], np.concatenate(columns)])
    middle, spread = _given(_mixture(data), PHASE, slice(1, 7))
    turns, places = frames(ends)
    total, weighted = np.zeros((PHASES, 3, 3)), np.zeros((PHASES, 3))
    for k in (0, 1):
        part, turn = slice(3 * k, 3 * k + 3), turns[k].as_matrix()
        precision = np.linalg.inv(turn @ spread[:, part, part] @ turn.T + 1e-6 * np.eye(3))
        total += precision
        weighted += np.einsum("tij,tj->ti", precision, turns[k].apply(middle[:, part]) * scale + places[k])
    return np.linalg.solve(total, weighted[:, :, None])[:, :, 0], gmr(shown, middle, ends)[1]


METHODS: dict[str, Method] = {
    "ours": ours,
    "ours from one": alone,
    "straight line": line,
    "medoid": medoid,
    "laid medoid": laid_medoid,
    "mean by phase, laid": mean,
    "DMP": dmp,
    "ProMP": promp,
    "GMR": gmr,
    "TP-GMM": tp_gmm,
}


def left_out(
    shown: list[Poses], methods: Iterable[Method], kept: Sequence[Sequence[int]] | None = None
) -> Iterator[Floats]:
    """Yield the errors of each method with one demonstration after the other left out, (demonstrations, 2).

    Args:
        shown: The demonstrations.
        methods: The methods.
        kept: For each demonstration left out, the indices of those to learn from; by default all others.
    """
    if kept is None:
        kept = [[i for i in range(len(shown)) if i != k] for k in range(len(shown))]
    apart = np.array([[0.0 if one is other else errors(one, other)[0] for other in shown] for one in shown])
    for made in methods:
        found = []
        for (tip, rotation), of in zip(shown, kept, strict=True):
            middle = shown[of[int(np.argmin(apart[np.ix_(of, of)].sum(axis=1)))]]
            motion = made([shown[i] for i in of], middle, (tip[[0, -1]], rotation[[0, -1]]))
            found.append(errors(motion, (tip, rotation)))
        yield np.array(found)


def interval(differences: Floats, seed: int = 0) -> tuple[float, float]:
    """Return the 95 % interval of a mean of paired differences, by bootstrap."""
    rng = np.random.default_rng(seed)
    means = rng.choice(differences, (10_000, len(differences))).mean(axis=1)
    return float(np.quantile(means, 0.025)), float(np.quantile(means, 0.975))


def surgeons_left_out(table: Table) -> None:
    """Add the errors of all methods on JIGSAWS, each surgeon left out, and the difference of ours from each."""
    for task, of in surgeons().items():
        users, shown = [user for user, _ in of], [one for _, one in of]
        found = dict(zip(METHODS, left_out(shown, METHODS.values(), drawn(users)), strict=True))
        table.add_row(f"{task}: {len(shown)} hand-offs of {len(set(users))} surgeons, {COMBINED} shown", "", "")
        for method, one in found.items():
            differences = (found["ours"] - one) / (1.0 if method == "ours" else one.mean(axis=0))
            position, turn = (
                f"{mean:.3g} {unit}"
                + (
                    ""
                    if method == "ours"
                    else f"; ours {100 * d.mean():+.1f} % ({100 * low:+.1f} to {100 * high:+.1f})"
                )
                for mean, unit, d in zip(one.mean(axis=0), ("mm", "degrees"), differences.T, strict=True)
                for low, high in [interval(d)]
            )
            table.add_row(f"{task}, surgeon left out: {method}", position, turn)


def pose_styles(table: Table) -> None:
    """Add the errors of all methods on the demonstrations left out, and the time of learning."""
    sets = motions()
    found = {name: dict(zip(METHODS, left_out(shown, METHODS.values()), strict=True)) for name, shown in sets.items()}
    for name, errs in found.items():
        for method, one in errs.items():
            mm = 1.0 if name == "regrasp" else 10.0
            position, turn = one.mean(axis=0) * (mm, 1.0)
            table.add_row(
                f"{name}, left out: {method}", f"{position:.3g} {'units' if mm == 1 else 'mm'}", f"{turn:.2f} degrees"
            )
    if "SKILLS_TEST_JIGSAWS" in os.environ:
        surgeons_left_out(table)
    together = {method: np.concatenate([found[name][method] for name in list(sets)[:3]]) for method in METHODS}
    for method, one in together.items():
        less = (together["ours"] - one) / one.mean(axis=0)
        shares = [
            f"{100 * d.mean():+.1f} % ({100 * low:+.1f} to {100 * high:+.1f})"
            for d in less.T
            for low, high in [interval(d)]
        ]
        table.add_row(f"CLFD together: ours against {method}", f"position {shares[0]}", f"orientation {shares[1]}")
    shown = [demo_of(one) for one in sets["openbox"]]
    ends = (shown[0].tip_mm[0], sets["openbox"][0][1][0], shown[0].tip_mm[-1], sets["openbox"][0][1][-1])
    style = learn_pose_style(shown)
    table.add_row("nine demonstrations: learn", f"{1000 * best_s(lambda: learn_pose_style(shown)):.1f} ms", "")
    table.add_row("nine demonstrations: a motion", f"{1000 * best_s(lambda: style.between(*ends)):.1f} ms", "")
