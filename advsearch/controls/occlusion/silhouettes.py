"""Silhouettes, which measure how much of a target an occluder hides in the image.

They are rasterized by NumPy, without a renderer. The occluder moves on a sphere around
the camera, and the same side of it always faces the camera. So its silhouette, as a set
of directions from the camera, turns rigidly. It is rasterized only once. For each
position of the occluder, the directions in which the target is visible are rotated and
looked up in the silhouette.

Coordinates are those of the camera: to the right, upwards and forwards, in object sizes.
Tangents are the first two, divided by the third.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advsearch.extend import assets, geometry, images

RASTER = 128  # pixels along the longer side of a silhouette
# number of angles at which the coverage is computed before the bisection
N_SCAN_ANGLES = 48
N_BISECTIONS = 12
DIRECTION_GRID = (
    24  # rows and columns of directions that are spread over the full image
)


@dataclass(frozen=True, eq=False)
class Silhouette:
    """The directions in which something is visible.

    Attributes:
        mask: (h, w) whether it is visible in each pixel of the window, with row 0 at
            the bottom.
        window: bounds of the mask in tangents.
    """

    mask: NDArray[np.bool_]
    window: geometry.Frame

    def list_directions(self) -> assets.Float64Array:
        """Return unit directions (N, 3) to the right, up and forward, one a covered pixel.

        Each stands for the same area of the image. Their positions within the pixels
        vary by a low-discrepancy sequence (Roberts 2018). If all were at pixel centers,
        the edge of a moving occluder would hide a full column of them at once.
        """
        row, column = np.nonzero(self.mask)
        height, width = self.mask.shape
        window = self.window
        index = np.arange(len(row))
        # 1 / g and 1 / g^2 of the plastic number g (Roberts 2018)
        x_in_pixels = column + (0.5 + 0.7548777 * index) % 1.0
        y_in_pixels = row + (0.5 + 0.5698403 * index) % 1.0
        # Tangents: on the plane at distance 1 in front of the camera. Rows go upwards.
        x = window.left + x_in_pixels * (window.right - window.left) / width
        y = window.low + y_in_pixels * (window.high - window.low) / height
        return _unit(np.stack([x, y, np.ones_like(x)], axis=-1))

    def contains(
        self,
        x: assets.Float64Array,
        y: assets.Float64Array,
        forwards: assets.Float64Array,
    ) -> NDArray[np.bool_]:
        """Return whether directions lie in the silhouette.

        Directions behind the camera do not.

        Args:
            x, y, forwards: components of the directions, to the right, up and forwards;
                all of the same shape. They need not have length 1.
        """
        height, width = self.mask.shape
        x_fraction, y_fraction = self._find_position_in_window(x, y, forwards)
        column = np.floor(x_fraction * width)
        row = np.floor(y_fraction * height)
        is_column_inside = (column >= 0) & (column < width)
        is_row_inside = (row >= 0) & (row < height)
        is_inside = (forwards > geometry.MIN_DEPTH) & is_column_inside & is_row_inside
        column = np.where(is_inside, column, 0).astype(np.int64)
        row = np.where(is_inside, row, 0).astype(np.int64)
        return np.asarray(is_inside & self.mask[row, column])

    def _find_position_in_window(
        self,
        x: assets.Float64Array,
        y: assets.Float64Array,
        forwards: assets.Float64Array,
    ) -> tuple[assets.Float64Array, assets.Float64Array]:
        """Return x and y of directions in the window, from 0 (left, below) to 1.

        The arguments are those of `contains`. Directions behind the camera get numbers
        without a meaning.
        """
        window = self.window
        # The limit only avoids a division by 0: `contains` excludes directions that do not
        # point forwards.
        depth = np.maximum(forwards, geometry.MIN_DEPTH)
        x_fraction = (x / depth - window.left) / (window.right - window.left)
        y_fraction = (y / depth - window.low) / (window.high - window.low)
        return x_fraction, y_fraction


def rasterise_silhouette(
    points: assets.Float64Array,
    faces: NDArray[np.uint32],
    frame: geometry.Frame | None = None,
) -> Silhouette | None:
    """Rasterise a mesh as the camera sees it; None if nothing of it is visible.

    Args:
        points: (V, 3) vertices in camera coordinates: right, up and forward.
        faces: (F, 3) vertex indices; faces that reach behind the camera are left out.
        frame: bounds of the image, in tangents; None for everything in front of the
            camera.
    """
    corners = points[faces.astype(np.int64)]
    corners = corners[(corners[..., 2] > geometry.MIN_DEPTH).all(axis=1)]
    if len(corners) == 0:
        return None
    tangents = corners[..., :2] / corners[..., 2:]
    window = _find_window(tangents, frame)
    if window is None:
        return None
    mask = _rasterise_tangents(tangents, window)
    return Silhouette(mask, window) if mask.any() else None


def _rasterise_tangents(
    tangents: assets.Float64Array, window: geometry.Frame
) -> NDArray[np.bool_]:
    """Return which pixels (h, w) of a window are covered by triangles.

    The longer side has `RASTER` pixels.

    Args:
        tangents: (F, 3, 2) corners of the triangles, in tangents.
        window: bounds of the pixels, in tangents.
    """
    window_width = window.right - window.left
    window_height = window.high - window.low
    height, width = _compute_raster_shape(window_height, window_width)
    # In the coordinates of `rasterize_triangles`, pixel centers are at whole numbers. So
    # the corner of the window, which is the corner of a pixel, is at -0.5.
    pixels_per_tangent = (width / window_width, height / window_height)
    in_pixels = (tangents - (window.left, window.low)) * pixels_per_tangent - 0.5
    _face, row, column, _weights = images.rasterize_triangles(
        in_pixels, (height, width)
    )
    mask = np.zeros((height, width), dtype=np.bool_)
    mask[row, column] = True
    return mask


def _compute_raster_shape(height: float, width: float) -> tuple[int, int]:
    """Return the rows and columns of a raster whose longer side has `RASTER` pixels.

    Args:
        height: height of the raster, in tangents.
        width: width of the raster, in tangents.
    """
    pixel = max(width, height) / RASTER
    rows = max(1, math.ceil(height / pixel))
    columns = max(1, math.ceil(width / pixel))
    return rows, columns


def _find_window(
    tangents: assets.Float64Array, frame: geometry.Frame | None
) -> geometry.Frame | None:
    """Return the bounding box of triangles in the image; None if it is empty.

    Args:
        tangents: (F, 3, 2) corners of the triangles, x / z and y / z.
        frame: bounds of the image that cut the box off; None for no bounds.
    """
    left, low = tangents.min(axis=(0, 1))
    right, high = tangents.max(axis=(0, 1))
    if frame is not None:
        left = max(left, frame.left)
        right = min(right, frame.right)
        low = max(low, frame.low)
        high = min(high, frame.high)
    if not (right > left and high > low):
        return None
    return geometry.Frame(float(left), float(right), float(low), float(high))


@dataclass(frozen=True, eq=False)
class Passage:
    """An occluder that moves sideways past a target, both as the camera sees them.

    Attributes:
        target_directions: (N, 3) unit directions in which the target is visible.
        occluder_silhouette: silhouette of the occluder when it is straight ahead of a camera.
        axes: (3, 3) rows right, up and forward of a camera that looks at the center of
            the target.
        direction: side that the occluder comes from, degrees: 0 is the right of the
            image, 90 the top.
    """

    target_directions: assets.Float64Array
    occluder_silhouette: Silhouette
    axes: assets.Float64Array
    direction: float

    def compute_coverage(self, angles: assets.Float64Array) -> assets.Float64Array:
        """Return the fraction of the target that is hidden at each angle, (K,).

        The occluder is not rasterized again for each angle. Instead, the directions of
        the target are expressed in the axes of a camera that looks at the occluder, and
        looked up in its silhouette.

        Args:
            angles: (K,) radians, between the centers of occluder and target as seen
                from the camera.
        """
        direction = math.radians(self.direction)
        # components of the target's directions, for a camera that looks at the target
        right, up, forward = (self.target_directions @ self.axes.T).T
        # The same in other axes of the image: towards the occluder, and at a right angle.
        outwards = math.cos(direction) * right + math.sin(direction) * up
        sideways = -math.sin(direction) * right + math.cos(direction) * up
        fractions = []
        for angle in angles:
            # Components for a camera that has turned outwards by the angle, to look at
            # the occluder: the target moves inwards.
            new_outwards = outwards * math.cos(angle) - forward * math.sin(angle)
            new_forward = outwards * math.sin(angle) + forward * math.cos(angle)
            fraction = self._compute_hidden_fraction(
                new_outwards, sideways, new_forward
            )
            fractions.append(fraction)
        return np.array(fractions)

    def _compute_hidden_fraction(
        self,
        outwards: assets.Float64Array,
        sideways: assets.Float64Array,
        forward: assets.Float64Array,
    ) -> float:
        """Return the fraction of the target's directions that the silhouette covers.

        The arguments are components (N,) of the directions for a camera that looks at
        the occluder.
        """
        direction = math.radians(self.direction)
        # back to the axes right and up
        right = math.cos(direction) * outwards - math.sin(direction) * sideways
        up = math.sin(direction) * outwards + math.cos(direction) * sideways
        is_hidden = self.occluder_silhouette.contains(right, up, forward)
        return float(is_hidden.mean())

    def find_angle(self, fraction: float, outside: float) -> float:
        """Find the largest angle, in radians, at which a fraction is hidden.

        The occluder moves in from outside and stops where it first hides that fraction.
        The angle is scanned in steps, and then bisected within a step: the result is
        right within a tiny interval, so that the fraction may be missed by as little. If
        the occluder never hides the fraction, the angle at which it hides most is
        returned.

        Args:
            fraction: fraction of the target that should be hidden.
            outside: angle at which the occluder is outside of the image, in radians.
        """
        angles = np.linspace(outside, 0.0, N_SCAN_ANGLES)
        fractions = self.compute_coverage(angles)
        sufficient = np.nonzero(fractions >= fraction)[0]
        if len(sufficient) == 0:
            return float(angles[int(np.argmax(fractions))])
        first = int(sufficient[0])
        is_enough_outside = first == 0
        if is_enough_outside:
            return float(angles[0])
        return self._bisect_angle(
            fraction, float(angles[first - 1]), float(angles[first])
        )

    def _bisect_angle(
        self, fraction: float, outer_angle: float, inner_angle: float
    ) -> float:
        """Return the angle, in radians, from which on a fraction is hidden.

        Args:
            fraction: fraction of the target that should be hidden.
            outer_angle: angle at which too little is hidden.
            inner_angle: angle at which enough is hidden.
        """
        for _ in range(N_BISECTIONS):
            middle = 0.5 * (outer_angle + inner_angle)
            if float(self.compute_coverage(np.array([middle]))[0]) >= fraction:
                inner_angle = middle
            else:
                outer_angle = middle
        return 0.5 * (outer_angle + inner_angle)


def spread_directions(frame: geometry.Frame) -> assets.Float64Array:
    """Return unit directions (N, 3) that are spread over a frame."""
    return Silhouette(
        np.ones((DIRECTION_GRID, DIRECTION_GRID), dtype=np.bool_), frame
    ).list_directions()


def compute_center_axes(directions: assets.Float64Array) -> assets.Float64Array:
    """Return a camera's axes (3, 3) turned to look at the middle of a silhouette.

    Rows are right, up and forward.

    Args:
        directions: (N, 3) unit directions of the silhouette's points, with components
            to the right, up and forward of the camera before it is turned.
    """
    forward = directions.mean(axis=0)
    forward = forward / max(float(np.linalg.norm(forward)), 1e-12)
    # `forward` is not parallel to `camera_up`, since the silhouette is in the image, in
    # front of the camera. Right, up and forward are left-handed: up x forward = right.
    camera_up = (0.0, 1.0, 0.0)
    right = np.cross(camera_up, forward)
    right = right / max(float(np.linalg.norm(right)), 1e-12)
    return np.stack([right, np.cross(forward, right), forward])


def find_angle_outside(
    directions: assets.Float64Array,
    rim: assets.Float64Array,
    cover: Silhouette,
    axes: assets.Float64Array,
    direction: float,
) -> float:
    """Return an angle in radians at which an occluder is just outside of the image.

    Angles are scanned from outside to the center. The result is the last one before the
    occluder covers any direction of the image.

    Args:
        directions: (N, 3) unit directions spread over the full image.
        rim: (M, 3) unit directions at the edge of the image.
        cover: silhouette of the occluder, straight ahead of the camera.
        axes: (3, 3) rows right, up and forward of a camera that looks at the target.
        direction: side that the occluder comes from, in degrees: 0 is the right, 90 the
            top.
    """
    max_angle = _find_max_angle(rim, cover, target_center=axes[2])
    # twice as dense as `find_angle` scans a smaller range
    angles = np.linspace(max_angle, 0.0, 2 * N_SCAN_ANGLES)
    # The target is here the full image: the fraction of it that is covered.
    image_passage = Passage(directions, cover, axes, direction)
    coverage = image_passage.compute_coverage(angles)
    indices_inside = np.nonzero(coverage > 0.0)[0]
    if not len(indices_inside):
        return float(angles[0])
    last_outside = max(int(indices_inside[0]) - 1, 0)
    return float(angles[last_outside])


def _find_max_angle(
    rim: assets.Float64Array, cover: Silhouette, target_center: assets.Float64Array
) -> float:
    """Return an angle in radians at which an occluder is surely outside of the image.

    It is that between the centers of occluder and target (3,), as seen from the camera.
    """
    # Largest angle between the occluder's center and a corner of the window around it.
    # The center is straight ahead, so that a corner's third component is the cosine.
    corners = cover.window.corners()
    occluder_radius = float(np.arccos(np.clip(corners[:, 2], -1.0, 1.0)).max())
    # largest angle between the target's center and the edge of the image
    image_radius = float(np.arccos(np.clip(rim @ target_center, -1.0, 1.0)).max())
    # a little beyond the edge (0.02 is about a degree), but not behind the camera
    return min(image_radius + occluder_radius + 0.02, 0.9 * math.pi)


def _unit(vectors: assets.Float64Array) -> assets.Float64Array:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))
