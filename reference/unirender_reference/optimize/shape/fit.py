"""Gauss-Newton steps of a mesh towards masks and, where their shading is given, pictures.

A step solves, for the movement d of the vertices v, in units of a pixel at the origin,

    min |C + J d - mask|^2 + |r + S d|^2 + smoothness |L (v + d)|^2 + stiffness |L d|^2 + damping |d|^2

with the coverage C and its derivative J along the outlines, the pictures' weighted error r and its derivative S, and
the uniform Laplacian L: a thin plate, which also keeps triangles even. The plate in the step is what large-steps
preconditioning [Nicolet et al. 2021] does for gradients; here the whole system is solved, by conjugate gradients.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import csr_array, eye_array, kron
from scipy.sparse.linalg import LinearOperator, cg

from unirender_reference.optimize.shape.cameras import Cameras
from unirender_reference.optimize.shape.silhouette import outline
from unirender_reference.optimize.shape.topology import neighbours
from unirender_reference.optimize.shape.tracer import MeshTracer

DAMPING = 0.02
SIDE = 4  # rays along the side of a pixel for its coverage
ITERATIONS = 60  # of conjugate gradients
LONGEST = 1.0  # pixels that a vertex moves in a step: outlines are linear within about a pixel


@dataclass(frozen=True)
class ImageTerm:
    """The pictures' part of the system, weighted.

    Attributes:
        error: of each channel of each pixel that counts.
        matrix: its derivative by the vertices (world units), coordinates of a vertex consecutive.
    """

    error: Float[np.ndarray, " r"]
    matrix: csr_array


class MeshFit:
    """A mesh that moves towards masks and pictures; the faces stay.

    Args:
        vertices: world positions to start from, one for each place (no seams).
        faces: counter-clockwise seen from outside.
        masks: coverage of each view.
        cameras: of the same views.

    Attributes:
        vertices: (n, 3) float64, where they are now.
    """

    def __init__(
        self,
        vertices: Float[np.ndarray, "n 3"],
        faces: Int[np.ndarray, "m 3"],
        masks: Float[np.ndarray, "k h w"],
        cameras: Cameras,
    ) -> None:
        self.vertices, self.faces = vertices.astype(np.float64), faces
        self._masks, self._cameras = masks, cameras
        self._tracer = MeshTracer(vertices, faces)
        plate = eye_array(len(vertices)) - neighbours(len(vertices), faces)
        self._plate = kron(plate.T @ plate, eye_array(3), format="csr")
        self._pixel = float((np.linalg.norm(cameras.center, axis=1) / cameras.focal).mean())

    def coverage(self) -> Float[np.ndarray, "k h w"]:
        """Of all views, where the mesh is now."""
        return self._tracer.coverage(self._cameras, SIDE)

    def step(
        self,
        smoothness: float,
        stiffness: float = 0.0,
        image: ImageTerm | None = None,
        coverage: Float[np.ndarray, "k h w"] | None = None,
    ) -> float:
        """One step; returns the root mean square error of the coverage before it.

        Args:
            smoothness: weight of the thin plate.
            stiffness: weight of the thin plate on the step.
            image: the pictures' term, or None: masks alone.
            coverage: what `coverage` returns, if it is known.
        """
        error = ((self.coverage() if coverage is None else coverage) - self._masks).ravel()
        edges = outline(self.vertices, self.faces, self._cameras, self._tracer)
        terms = [(error, edges.matrix(error.size, len(self.vertices)) * self._pixel)]
        if image is not None:
            terms.append((image.error, image.matrix * self._pixel))
        plate, bent = self._plate, self._plate @ (self.vertices.ravel() / self._pixel)
        gradient = smoothness * bent + sum(matrix.T @ values for values, matrix in terms)
        diagonal = (smoothness + stiffness) * plate.diagonal() + DAMPING
        diagonal = diagonal + sum(np.asarray(matrix.multiply(matrix).sum(0)).ravel() for _, matrix in terms)

        def curvature(direction: np.ndarray) -> np.ndarray:
            total = (smoothness + stiffness) * (plate @ direction) + DAMPING * direction
            return total + sum(matrix.T @ (matrix @ direction) for _, matrix in terms)

        system, jacobi = (
            LinearOperator((self.vertices.size,) * 2, matvec=function, dtype=np.float64)  # pyright: ignore[reportCallIssue] - scipy's stubs want another constructor
            for function in (curvature, lambda direction: direction / diagonal)
        )
        move, _ = cg(system, -gradient, rtol=1e-3, maxiter=ITERATIONS, M=jacobi)
        move = move.reshape(-1, 3)
        length = np.linalg.norm(move, axis=1, keepdims=True)
        move *= np.minimum(1, LONGEST / np.maximum(length, 1e-12))
        self.vertices = self.vertices + move * self._pixel
        self._tracer.move(self.vertices)
        return float(np.sqrt((error**2).mean()))
