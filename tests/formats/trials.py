"""A small folder in the layout of JIGSAWS, entirely synthetic: no person's data, and none of the data set."""

from pathlib import Path

import numpy as np

RATE_HZ = 30.0
GESTURES = "1 60 G1 \n61 150 G6 \n151 240 G4 \n241 300 G11 \n"
META = "Suturing_B001\t\tN\t13\t\t3\t2\t1\t2\t2\t3\r\nSuturing_C002\t\tE\t27\t\t5\t4\t5\t4\t5\t4\r\n\r\n"


def turning(angles: np.ndarray) -> np.ndarray:
    """Return rotations about z, then about x: shape (T, 3, 3)."""
    c, s, one, zero = np.cos(angles), np.sin(angles), np.ones_like(angles), np.zeros_like(angles)
    about_z = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    about_x = np.stack([one, zero, zero, zero, c, -s, zero, s, c], axis=1).reshape(-1, 3, 3)
    return about_z @ about_x


def kinematics(rows: int = 300, shift: float = 0.0) -> np.ndarray:
    """Return one trial, shape (rows, 76): each arm sweeps, rotates and closes its gripper from its own start."""
    t = np.arange(rows) / RATE_HZ
    arms = []
    for k in range(4):
        way = 0.02 * (1 - np.cos(np.pi * np.clip(t / t[-1], 0, 1))) + shift
        place = np.stack([0.01 * k + way, 0.05 + way / 2, -0.10 + 0.01 * np.sin(t)], axis=1)
        turns = turning(0.3 * k + t / 5).reshape(rows, 9)
        gripper = np.where((t > t[-1] * 0.2) & (t < t[-1] * 0.8), -0.5, 0.4)
        arms.append(np.hstack([place, turns, np.zeros((rows, 6)), gripper[:, None]]))
    return np.hstack(arms)


def text(table: np.ndarray) -> bytes:
    """Format numbers as the data set does: six decimals, spaces, a space at the end of a row."""
    return "".join(" ".join(f"{value: .6f}" for value in row) + " \n" for row in table).encode()


def handing_over(opens_s: float, parts_s: float) -> np.ndarray:
    """Return a trial in which the right instrument carries a needle, gives it to the left one, and goes away.

    The left one closes 0.5 s before the right one opens, and opens at 8.5 s. The right one moves at 40 mm/s, also
    for a fifth of a second before it is 5 mm away at `parts_s`.
    """
    table, t = kinematics(), np.arange(300) / RATE_HZ
    moved = 0.02 * np.clip(t - 0.5, 0, 2) - 0.04 * np.clip(t - parts_s + 0.125, 0, 1)
    for first, way, shut in ((38, moved, (t > 0.3) & (t < opens_s)), (57, 0.0 * t, (t > opens_s - 0.5) & (t < 8.5))):
        table[:, (19 if first == 38 else 0) + np.arange(3)] = table[:, first : first + 3] = [0.02, 0.05, -0.10]
        table[:, first] += way
        table[:, 19 if first == 38 else 0] += way
        table[:, first + 18] = np.where(shut, -0.5, 0.4)
    return table


def swaying() -> np.ndarray:
    """Return a trial in which each arm sways by 1.8 mm about its place, with its gripper closed."""
    table, t = kinematics(), np.arange(300) / RATE_HZ
    for first in (0, 19, 38, 57):
        table[:, first : first + 3] = [0.02, 0.05, -0.10]
        table[:, first] += 0.0018 * np.sin(np.pi * np.clip(t - 2.5, 0, 4))
    return table


def folder(root: Path) -> Path:
    """Write two trials of two surgeons, their gestures and their meta file."""
    task = root / "Suturing"
    for name, shift in (("Suturing_B001", 0.0), ("Suturing_C002", 0.01)):
        for inside, data in (
            ("kinematics/AllGestures", text(kinematics(shift=shift))),
            ("transcriptions", GESTURES.encode()),
        ):
            path = task / inside / f"{name}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
    (task / "meta_file_Suturing.txt").write_bytes(META.encode())
    return root
