"""Compares elements and meshes for soft tissue with a converged solution of linear elasticity.

Run: python -m docs.studies.tissue_mesh [--reference]

A sheet of 60 x 40 x 5 mm hangs under its weight, held at its rim, or is pressed by 0.1 N on the middle 10 x 10 mm of
its upper face, held at its rim or at its lower face. Droop is that of the middle of the upper face; indentation is the
mean over the pressed part. A quarter of the sheet is solved, in float64.

The reference has triquadratic elements of 27 nodes, finer towards the rim. `--reference` computes it again, and needs
scikit-fem, of which nothing else here makes use.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import cg, spsolve

from docs.studies.command import make_parser, run
from surgical_marl.physics.systems.brick import (
    CORNERS,
    condensed,
    elasticity,
    gauss_points,
    nodal_strains,
    quadratic_strains,
)

SIZE, PATCH = np.array([0.06, 0.04, 0.005]), 0.005
"""The sheet, and half the side of the part that is pressed, m."""
YOUNG, DENSITY, GRAVITY, PRESS = 27040.0, 1000.0, 9.81, 0.1
MESHES = ((12, 8, 1), (12, 8, 2), (24, 16, 1), (24, 16, 2), (24, 16, 4))
REFINED = ((6, 4, 2), (12, 8, 3), (18, 12, 4), (24, 16, 5), (30, 20, 6))
"""Quadratic elements of a quarter."""
GRADING = 1.6
"""Elements of the reference shrink towards the rim: their nodes are at 1 - (1 - t) ** GRADING."""
NOTHING = np.zeros((6, 0))
VOLUME = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


class Found(NamedTuple):
    """Displacements, mm."""

    droop: float
    """Held at the rim, of its weight."""
    pressed: float
    """Held at the rim, of the pressure."""
    bedded: float
    """Held at the lower face, of the pressure."""


REFERENCE = {0.4287: Found(0.9761, 3.1555, 0.0873), 0.0: Found(1.1370, 3.7838, 0.1465)}
"""By Poisson's ratio, from `--reference`."""

Operator = Callable[[np.ndarray, np.ndarray], np.ndarray]


def mean_dilatation(point: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the strains of nodes with the volumetric part of their mean (T. J. R. Hughes' B-bar, 1980)."""
    own = nodal_strains(point, size)
    mean = sum(nodal_strains(at, size) for at in gauss_points()) / 8
    return own + np.outer(VOLUME, VOLUME @ (mean - own)) / 3


def volumetric(point: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return three more strains that change the volume alone (J. C. Simo, F. Armero, R. L. Taylor, 1993)."""
    x, y, z = point
    return np.outer(VOLUME, [x * y, y * z, z * x])


def bilinear(point: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return 12 more enhanced strains, products of two coordinates (U. Andelfinger, E. Ramm, 1993)."""
    x, y, z = point
    found = np.zeros((6, 12))
    places = (0, 0, 1, 1, 2, 2, 3, 3, 4, 4, 5, 5)
    found[places, range(12)] = [x * y, x * z, x * y, y * z, z * x, z * y, z * x, z * y, x * y, x * z, y * x, y * z]
    return found


ELEMENTS: dict[str, tuple[Operator, ...]] = {
    "trilinear": (nodal_strains,),
    "B-bar": (mean_dilatation,),
    "Wilson (QM6)": (nodal_strains, quadratic_strains),
    "Wilson, B-bar": (mean_dilatation, quadratic_strains),
    "enhanced, 12 modes": (nodal_strains, quadratic_strains, volumetric),
    "enhanced, 21 modes": (nodal_strains, quadratic_strains, bilinear),
}


def held_at(place: np.ndarray, support: str) -> np.ndarray:
    """Return which displacements of points of a quarter, m, [n, 3], are 0, [n, 3] bool: by symmetry, or held."""
    near = 1e-9
    found = np.zeros(place.shape, bool)
    found[:, :2] = place[:, :2] < near
    rim = (place[:, :2] > SIZE[:2] / 2 - near).any(1)
    found[rim if support == "rim" else place[:, 2] < near] = True
    return found


def solve_bricks(cells: tuple[int, int, int], operators: tuple[Operator, ...], poisson: float) -> Found:
    """Return the displacements of a sheet of so many bricks (of the whole sheet)."""
    size, count = SIZE / cells, np.array([cells[0] // 2, cells[1] // 2, cells[2]])
    nodes = np.stack(np.meshgrid(*[np.arange(n + 1) for n in count], indexing="ij"), -1).reshape(-1, 3)
    first = np.stack(np.meshgrid(*[np.arange(n) for n in count], indexing="ij"), -1).reshape(-1, 1, 3)
    elements = np.ravel_multi_index(tuple(np.moveaxis(first + CORNERS, -1, 0)), count + 1)
    places = (3 * elements[:, :, None] + np.arange(3)).reshape(len(elements), 24)
    own = condensed(size, elasticity(YOUNG, poisson), *operators)
    rows, columns = np.repeat(places, 24, 1).ravel(), np.tile(places, (1, 24)).ravel()
    matrix = sparse.coo_matrix((np.tile(own.ravel(), len(elements)), (rows, columns))).tocsc()

    weight = np.zeros(nodes.shape)
    np.add.at(weight[:, 2], elements, -DENSITY * GRAVITY * size.prod() / 8)
    under = elements[(first[:, 0, 2] == count[2] - 1) & ((first[:, 0, :2] + 0.5) * size[:2] < PATCH).all(1)]
    pressure = np.zeros(nodes.shape)
    np.add.at(pressure[:, 2], under[:, CORNERS[:, 2] == 1], -1 / (4 * len(under)))
    middle = int(np.ravel_multi_index((0, 0, count[2]), count + 1))

    def displacements(support: str, *loads: np.ndarray) -> list[np.ndarray]:
        free = np.flatnonzero(~held_at(nodes * size, support))
        found = np.zeros((nodes.size, len(loads)))
        right = np.stack([load.ravel() for load in loads], 1)[free]
        found[free] = spsolve(matrix[free][:, free], right).reshape(len(free), -1)
        return [column.reshape(-1, 3) for column in found.T]

    hanging, pressed = displacements("rim", weight, pressure)
    (bedded,) = displacements("bed", pressure)
    mean = 1e3 * PRESS / 4
    return Found(-1e3 * hanging[middle, 2], mean * np.sum(pressure * pressed), mean * np.sum(pressure * bedded))


def solve_quadratic(cells: tuple[int, int, int], poisson: float) -> Found:
    """Return the displacements of a quarter of the sheet of so many triquadratic elements, by scikit-fem."""
    import skfem
    from skfem.helpers import ddot, div, sym_grad

    lame, shear = YOUNG * poisson / (1 + poisson) / (1 - 2 * poisson), YOUNG / 2 / (1 + poisson)

    def axis(count: int, end: float) -> np.ndarray:
        inner = max(1, round(count * PATCH / end))
        share = 1 - (1 - np.linspace(0, 1, count - inner + 1)) ** GRADING
        return np.concatenate([np.linspace(0, PATCH, inner + 1)[:-1], PATCH + (end - PATCH) * share])

    axes = axis(cells[0], SIZE[0] / 2), axis(cells[1], SIZE[1] / 2), np.linspace(0, SIZE[2], cells[2] + 1)
    mesh = skfem.MeshHex.init_tensor(*axes)
    element = skfem.ElementVector(skfem.ElementHex2())
    basis = skfem.Basis(mesh, element, intorder=4)
    matrix = skfem.BilinearForm(
        lambda u, v, _: lame * div(u) * div(v) + 2 * shear * ddot(sym_grad(u), sym_grad(v))
    ).assemble(basis)
    face = mesh.facets_satisfying(lambda x: (x[2] > SIZE[2] - 1e-9) & (x[0] < PATCH) & (x[1] < PATCH))
    weight = skfem.LinearForm(lambda v, _: -DENSITY * GRAVITY * v[2]).assemble(basis)
    pressure = skfem.LinearForm(lambda v, _: -v[2] / PATCH**2).assemble(skfem.FacetBasis(mesh, element, facets=face))

    components = np.zeros(matrix.shape[0], int)
    for number in range(3):
        components[basis.get_dofs(elements=np.arange(mesh.nelements)).all([f"u^{number + 1}"])] = number
    place = basis.doflocs.T
    below = np.abs(place - [0, 0, SIZE[2]]).max(1) < 1e-9
    middle = int(np.flatnonzero(below & (components == 2))[0])

    def displacement(support: str, load: np.ndarray) -> np.ndarray:
        free = np.flatnonzero(~held_at(place, support)[np.arange(len(place)), components])
        own = matrix[free][:, free].tocsr()
        found = np.zeros(len(place))
        found[free], failed = cg(own, load[free], rtol=1e-9, M=sparse.diags(1 / own.diagonal()), maxiter=20000)
        if failed:
            raise ValueError("the reference's conjugate gradients do not converge")
        return found

    hanging, pressed, bedded = (displacement(*case) for case in (("rim", weight), ("rim", pressure), ("bed", pressure)))
    mean = 1e3 * PRESS / 4
    return Found(-1e3 * hanging[middle], mean * (pressure @ pressed), mean * (pressure @ bedded))


def table(poisson: float) -> list[str]:
    """Return the rows of a table of errors, of all elements and meshes at a Poisson's ratio."""
    exact = REFERENCE[poisson]
    rows = [f"Poisson's ratio {poisson:g}: " + ", ".join(f"{name} {mm:.4f} mm" for name, mm in exact._asdict().items())]
    for (name, operators), cells in product(ELEMENTS.items(), MESHES):
        found = solve_bricks(cells, operators, poisson)
        off = " ".join(f"{100 * (mm / right - 1):+7.1f} %" for mm, right in zip(found, exact, strict=True))
        rows.append(f"{name:20s} {' x '.join(map(str, cells)):12s} {off}")
    return rows


def main(argv: list[str] | None = None) -> int:
    """Print the table, or compute its reference."""
    parser = make_parser(__doc__)
    parser.add_argument("--reference", action="store_true", help="refine quadratic elements until they stand still")
    options: Any = parser.parse_args(argv)
    for poisson in REFERENCE:
        if options.reference:
            for cells in REFINED:
                print(poisson, cells, *(f"{mm:.5f}" for mm in solve_quadratic(cells, poisson)), flush=True)
        else:
            print("\n".join(table(poisson)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run("tissue_mesh", main))
