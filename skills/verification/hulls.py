"""Outlines of the arms' bodies as convex hulls of points, and lower bounds on the distances between them.

    points of two hulls --hulls_apart--> mm

A body is all that is within `OUTLINE_MM` of the hull of its points. The points are corners of the hull of the
manufacturer's mesh, chosen one by one, the furthest first, until no part of the mesh is more than 4 mm from their hull:
so a body contains its mesh with `MARGIN_MM` to spare, and a plane face stands out by 5 mm.

The distance is that of the Gilbert-Johnson-Keerthi algorithm (IEEE J. Robotics and Automation 4, 1988): the point of
the difference of two hulls that is nearest to the origin, from one simplex of corners to the next. In each round every
corner lies beyond a plane across the way to the nearest point so far; the distance of that plane is a lower bound,
whatever round-off does to the point, and this bound is returned.

**Sources.** Meshes of jhu-dvrk/dvrk_model (MIT licence, 2024 da Vinci Research Kit) in the places that its URDF gives
them at zero joints, in mm from the remote centre: x to the side, y away from the base, z up. The Classic's carriage is
the housing of its instrument; the Si's was not to be had.
"""

import numpy as np

from skills.arrays import Floats

OUTLINE_MM = 5.0
MARGIN_MM = 0.5  # ours: what a body is larger than its mesh, at least
_ROUNDS = 40
_PRECISE_MM = 0.05  # between the bound and the distance of the nearest point that was found
_FACES = np.array([[k >> corner & 1 for corner in range(4)] for k in range(1, 16)], bool)  # of a simplex


def hulls_apart(points: Floats, others: Floats, enough_mm: float) -> Floats:
    """Return lower bounds on the distances of N convex hulls from N others; negative where they overlap.

    Args:
        points: Points of the hulls in mm, shape (N, K, 3); a point may occur again.
        others: Points of the others in the same frame, shape (N, L, 3).
        enough_mm: A distance above which a bound need not be close.
    """
    nearest = points.mean(axis=1) - others.mean(axis=1)
    least, left = np.full(len(points), -np.inf), np.arange(len(points))
    simplex, used = np.zeros((len(points), 4, 3)), np.zeros((len(points), 4), bool)
    for _ in range(_ROUNDS):
        way, row = nearest[left], np.arange(len(left))
        length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
        corner = points[left, np.einsum("nkj,nj->nk", points[left], way).argmin(axis=1)]
        corner = corner - others[left, np.einsum("nkj,nj->nk", others[left], way).argmax(axis=1)]
        least[left] = np.maximum(least[left], (corner * way).sum(axis=1) / length)
        going = (least[left] < enough_mm) & (length - least[left] > _PRECISE_MM) & ~used[left].all(axis=1)
        if not going.any():
            break
        left, corner, row = left[going], corner[going], row[: np.count_nonzero(going)]
        place = used[left].argmin(axis=1)
        simplex[left, place], used[left, place] = corner, True
        nearest[left], used[left] = _nearest(simplex[left], used[left])
    return least


def _nearest(simplex: Floats, used: np.ndarray) -> tuple[Floats, np.ndarray]:
    """Return the points nearest to the origin in N simplices, (N, 4, 3), and the corners of their faces, (N, 4)."""
    gram = np.einsum("nij,nkj->nik", simplex, simplex)
    gram = gram + 1e-9 * (1.0 + np.trace(gram, axis1=1, axis2=2))[:, None, None] * np.eye(4)
    apart = np.where(_FACES[:, :, None] & _FACES[:, None], gram[:, None], np.eye(4))
    share = np.linalg.solve(apart, np.broadcast_to(_FACES[..., None], (*apart.shape[:3], 1)).astype(float))[..., 0]
    share = share * _FACES / (share * _FACES).sum(axis=2, keepdims=True)
    point = share @ simplex
    inside = (share >= 0.0).all(axis=2) & ~(_FACES & ~used[:, None]).any(axis=2)
    face = np.where(inside, (point**2).sum(axis=2), np.inf).argmin(axis=1)
    return point[np.arange(len(point)), face], _FACES[face]


def _outlines(text: str) -> dict[str, Floats]:
    """Return the points of each body, shape (K, 3), by its name."""
    bodies = (one.split(":") for one in text.split(";"))
    return {" ".join(name.split()): np.array([one.split() for one in rows.split(",")], float) for name, rows in bodies}


CLASSIC_OUTLINES = _outlines("""
base: -86 -749 23, -86 -748 -155, -86 -670 -155, -86 -668 -140, -84 -698 30, -81 -709 46, -77 -760 43, -73 -768 29, -73
-692 49, -71 -749 58, -70 -770 -139, -66 -703 63, -56 -773 -125, -55 -681 48, -52 -743 71, -51 -771 51, -50 -760 66,
-44 -692 67, -36 -743 73, 37 -692 68, 43 -764 64, 46 -679 41, 52 -743 71, 52 -709 71, 58 -684 53, 64 -772 -132, 65 -771
37, 65 -754 62, 66 -703 63, 75 -754 51, 77 -692 43, 81 -760 -150, 81 -760 30, 81 -709 46, 84 -669 -110, 86 -703 23, 87
-743 -155, 87 -743 23, 87 -670 -155; yaw link: -86 -649 4, -86 -649 12, -86 -621 -51, -86 -585 -86, -86 -537 -102, -86
-499 -99, -86 -444 -67, -86 -404 12, -76 -669 12, -76 -591 -90, -76 -384 12, -73 -669 -10, -73 -384 -10, -57 -679 7,
-57 -679 12, -57 -374 7, -57 -374 12, -56 -578 -109, -56 -537 -119, -56 -456 -99, -49 -388 -51, -47 -669 -48, -35 -679
-33, -34 -504 -125, -25 -374 -39, -23 -592 -113, -23 -560 -125, -23 -461 -113, -20 -665 -65, -20 -388 -65, 0 -527 -131,
0 -481 -123, 9 -679 -44, 11 -571 -123, 12 -384 -63, 20 -665 -65, 25 -374 -39, 34 -591 -111, 34 -504 -125, 34 -462 -111,
45 -537 -123, 49 -665 -51, 49 -388 -51, 57 -679 12, 57 -374 7, 57 -374 12, 63 -669 -31, 63 -384 -31, 66 -594 -95, 75
-384 -3, 76 -479 -99, 80 -665 12, 83 -393 12, 86 -609 -67, 86 -566 -95, 86 -516 -102, 86 -477 -91, 86 -444 -67, 87 -644
12; insertion axis: -38 -59 142, -38 -24 142, -35 -57 571, -33 -65 156, -31 -28 571, -29 -65 138, -29 -65 573, -29 -58
579, -28 -33 579, 33 -27 571, 34 -33 579, 35 -65 573, 35 -59 579, 39 -65 143, 41 -59 573, 41 -33 573, 44 -59 142, 44
-24 142; carriage: -34 -16 406, -33 -16 434, -32 -27 414, -32 -27 429, -32 9 435, -30 -27 358, -30 8 358, -25 9 439,
-24 -27 437, -21 -27 349, -19 16 350, -19 16 421, -4 -2 318, 4 2 318, 20 15 348, 24 -27 437, 27 -27 353, 29 9 356, 30
11 437, 32 -27 429, 34 -16 406, 34 -16 431; cannula mount: -38 -59 130, -38 -59 142, -36 -24 144, -33 -65 129, -33 -15
125, -28 -65 145, -21 -19 79, -20 -31 80, 27 -31 80, 29 -17 82, 38 -65 128, 39 -65 143, 40 -15 125, 44 -60 128, 44 -50
146, 44 -24 142, -10 5 60, -10 5 95, 10 5 60, 10 5 95; base plate: -86 -674 -121, -86 -670 -155, -86 -614 -155, -83
-617 -112, -81 -672 -102, -70 -630 -99, -62 -672 -86, -39 -568 -155, -39 -568 -150, -25 -567 -155, 39 -568 -155, 39
-567 -150, 68 -673 -87, 76 -624 -103, 78 -674 -95, 86 -615 -119, 87 -674 -121, 87 -670 -155, 87 -614 -155; base front:
-39 -574 -155, -39 -424 -155, -39 -369 -70, -38 -369 -7, -24 -369 11, -9 -374 15, 9 -369 15, 24 -374 11, 29 -575 -155,
38 -369 -7, 39 -574 -155, 39 -424 -155, 39 -369 -70; rear bar: -23 -280 142, -23 -232 142, -23 -232 159, -16 -569 142,
-16 -569 160, -16 -511 200, -16 -306 200, -16 -230 142, 19 -569 142, 19 -569 160, 19 -511 200, 19 -306 200, 26 -280
142, 26 -232 142, 26 -232 159; lower bar: -46 -159 142, -46 -159 159, -46 -35 142, -46 -35 159, -23 -236 159, -19 -238
142, 26 -236 142, 26 -236 159, 50 -159 142, 50 -159 159, 50 -35 142, 50 -35 159; upper bar: -5 -570 179, -5 -570 195,
-5 -248 195, -5 -247 180, -3 -570 178, 10 -248 178, 11 -570 195, 12 -570 180, 12 -248 194; upper plate: -42 -157 178,
-42 -157 195, -42 -41 178, -42 -41 195, -42 -36 183, -5 -252 180, -5 -252 193, 12 -252 180, 12 -252 193, 48 -157 178,
48 -157 195, 48 -41 178, 48 -41 195, 48 -36 190
""")
SI_OUTLINES = _outlines("""
base: -54 -843 -35, -54 -843 35, -54 -695 -35, -54 -695 35, -44 -685 -5, -34 -695 -44, -34 -695 44, -33 -685 30, -7
-843 -50, -7 -843 50, -7 -695 50, 0 -685 -44, 0 -685 44, 7 -695 -50, 21 -843 -48, 21 -843 48, 21 -695 48, 33 -685 30,
44 -685 -5, 47 -695 -39, 54 -843 -35, 54 -843 35, 54 -695 -35, 54 -695 35; yaw link: -142 -646 -33, -142 -597 -33, -142
-596 33, -140 -656 33, -126 -670 -33, -126 -670 33, -76 -597 -33, -76 -596 33, -44 -685 -7, 3 -685 -44, 3 -685 44, 11
-634 31, 16 -672 -41, 21 -634 -25, 28 -685 -35, 28 -685 35, 29 -634 17, 33 -634 -6, 37 -672 -25, 37 -672 25, 44 -685 0;
yaw arm: -142 -600 -29, -142 -596 33, -142 -396 -103, -142 -371 -42, -142 -368 -99, -142 -353 -69, -138 -601 33, -80
-601 33, -76 -602 17, -76 -597 -33, -76 -590 33, -76 -393 -118, -76 -339 -71, -70 -433 -71, -70 -406 -114, -70 -380
-118, -70 -367 -28, -70 -356 -107, -70 -347 -46, -70 -341 -84; lever: -70 -433 -75, -70 -383 -118, -70 -360 -110, -70
-348 -45, -70 -340 -80, -64 -569 16, -64 -564 -3, -64 -532 119, -64 -506 134, -64 -490 -108, -64 -485 131, -64 -472
-114, -64 -470 118, 63 -567 25, 63 -564 -3, 63 -532 119, 63 -506 134, 63 -490 -108, 63 -477 126, 63 -472 -114, 64 -383
-118, 64 -360 -110, 64 -348 -45, 64 -344 -92, 64 -340 -68; rear bar: -30 -539 99, -30 -532 74, -30 -510 59, -30 -484
63, -30 -471 264, -30 -466 82, -30 -454 281, -30 -441 284, -30 -420 184, -30 -420 281, -30 -419 240, 30 -539 99, 30
-532 74, 30 -510 59, 30 -496 59, 30 -473 71, 30 -471 264, 30 -454 281, 30 -420 184, 30 -420 281; bars: -30 -426 195,
-30 -425 282, -30 -424 178, -30 -110 134, -30 -106 209, -30 -87 146, -30 -84 195, -30 -77 170, 30 -426 238, 30 -424
178, 30 -424 282, 30 -110 134, 30 -94 204, 30 -87 146, 30 -84 195, 30 -77 170; insertion axis: -28 -124 169, -28 -87
591, -28 -86 145, -28 -64 142, -28 -64 591, 28 -124 169, 28 -87 591, 28 -86 145, 28 -64 142, 28 -64 591; cannula mount:
-28 -87 79, -28 -87 151, -28 -64 150, -14 5 79, -14 5 104, -12 -8 69, -6 3 69, 11 -2 69, 14 5 79, 14 5 104, 28 -87 79,
28 -87 151, 28 -64 150
""")
