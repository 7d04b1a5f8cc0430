"""Detection: supporting planes and the objects on them (thesis ch. 4).

`detect` turns a frame into a `shapecat.types.Scene`.

Terms in all steps:

- A *cell* is an element of the downsampled depth image (`DepthGrid`); an array (rows, columns) has
  a value for each. An *object cell* is above a plane (`HeightMap.plane_id` > 0); a *low cell* is on
  a plane, or less than `LowProfileSettings.low_m` above it.
- The *view frame* is the coordinate frame of the camera of the grid: of the virtual camera for a
  point cloud, the sensor frame for a depth image. All steps but the last call it the sensor
  frame.
- ``plane`` (3,) is a, b, c of a plane's inverse depth, ``a * column + b * row + c``, 1/m. ``up``
  (3,) is a unit vector in the view frame. ``jump`` is `DepthGrid.discontinuity`, 1/m.
- ``spans`` (rows, 2) bound the cells that matter in each row: the first column that has one, and
  one past the last.
"""

from shapecat.detection.pipeline import detect

__all__ = ["detect"]
