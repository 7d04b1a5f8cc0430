"""The layout of the review: its views, and the eye of each 3D view."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from shapecat.arrays import F8
from shapecat.geometry import IDENTITY, transform
from shapecat.types import Frame, LabelledFrame, Pose

__all__ = ["Eye", "TrackView", "choose_eye", "lay_out", "send_layout", "stepped_back"]

_BACKGROUND = (16, 18, 23)
_TIME = rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal)  # all plots show the same times
_WIDEST_M = 1.5  # largest radius of a scene that is shown as a whole
_MOST_TRACKS = 48  # views, for the longest tracks; the recording holds all tracks


@dataclass(frozen=True)
class Eye:
    """The eye of a 3D view: position, target and up direction (3,), metres, in the view's frame."""

    position: F8
    target: F8
    up: F8


@dataclass
class TrackView:
    """A track to plot; ``frames`` is the number of frames that show it."""

    entity: str
    title: str
    frames: int = 0


class _Layout(rrb.Blueprint):  # type: ignore[misc]  # Rerun is untyped
    """A blueprint that keeps the stream to which Rerun writes it, so that it can be closed."""

    stream: rr.RecordingStream | None = None

    def _log_to_stream(self, stream: rr.RecordingStream) -> None:
        self.stream = stream
        super()._log_to_stream(stream)


def choose_eye(labelled: LabelledFrame, frame: Frame, *, fixed: bool) -> Eye:
    """Choose the eye of a 3D view: it looks at the objects from the sensor's side and from above.

    Its coordinates are in the fixed frame if ``fixed``, else in the sensor frame.
    """
    pose = labelled.fixed_from_sensor if fixed else None
    pose = pose or IDENTITY
    up = np.array([0.0, 0.0, 1.0]) if fixed else _up(labelled, frame)
    target, radius = _subject(labelled, frame, pose)
    back = pose.translation - target
    back = back - (back @ up) * up
    norm = np.linalg.norm(back)
    back = back / norm if norm > 1e-3 else np.zeros(3)
    side = np.cross(up, back)  # from one side, so that the drawn sensor does not block the view
    distance = max(0.6, 2.2 * radius)
    return Eye(target + distance * (0.7 * back + 0.3 * side + 0.6 * up), target, up)


def stepped_back(eye: Eye, low: F8, high: F8) -> Eye:
    """Aim an eye at the box between two corners (3,), metres, and move it back to see the box.

    If the box is too large or empty, the eye is returned unchanged.
    """
    radius = float(np.linalg.norm(high - low) / 2) + 0.1
    if not radius <= _WIDEST_M:
        return eye
    away = eye.position - eye.target
    distance = max(float(np.linalg.norm(away)), 2.2 * radius)
    middle = (low + high) / 2
    return Eye(middle + away / np.linalg.norm(away) * distance, middle, eye.up)


def _up(labelled: LabelledFrame, frame: Frame) -> F8:
    """Return the up direction (3,) of a frame; for a cloud without planes, the z axis."""
    if labelled.planes or frame.organized:
        return np.asarray(labelled.up, np.float64)
    return np.array([0.0, 0.0, 1.0])  # as of a lidar; detection assumes a camera


def _subject(labelled: LabelledFrame, frame: Frame, pose: Pose) -> tuple[F8, float]:
    """Return a sphere around the objects, or else around the planes or the points.

    The result is its centre (3,), in the frame to which ``pose`` transforms, and radius, metres.
    """
    if labelled.objects:
        half = [np.full(3, o.box.size.max() / 2) for o in labelled.objects]
        centers = np.array([o.box.center for o in labelled.objects])
        points = np.concatenate([centers - half, centers + half])
    elif labelled.planes:
        points = np.concatenate([plane.outline for plane in labelled.planes])
    else:
        points = frame.finite_xyz()
    if len(points) == 0:
        points = np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    return transform(pose, (low + high) / 2), float(np.linalg.norm(high - low) / 2)


def lay_out(
    scenes: Sequence[tuple[str, str, Eye]],
    tracks: Sequence[TrackView],
    images: Mapping[str, str] | None = None,
) -> _Layout:
    """Return the blueprint: 3D and colour views on the left; tracks, plots, texts on the right.

    Parameters
    ----------
    scenes : entity, title and eye of each 3D view.
    tracks : all tracks, in order of their numbers.
    images : title of each colour image view, by entity.
    """
    left = _one_of([_scene_view(*scene) for scene in scenes])
    if images:
        pictures = [
            rrb.Spatial2DView(origin=entity, name=title, background=_BACKGROUND)
            for entity, title in images.items()
        ]
        left = rrb.Vertical(left, _one_of(pictures), row_shares=[5, 4])
    return _Layout(
        rrb.Horizontal(
            left,
            rrb.Vertical(
                _track_tabs(tracks),
                rrb.Tabs(
                    rrb.TimeSeriesView(origin="/plots/objects", name="Objects", axis_x=_TIME),
                    rrb.TimeSeriesView(
                        origin="/plots/seconds", name="Seconds per frame", axis_x=_TIME
                    ),
                ),
                rrb.Tabs(
                    rrb.TextLogView(
                        origin="/log",
                        name="Events",
                        columns=rrb.TextLogColumns(text_log_columns=["LogLevel", "Body"]),
                    ),
                    rrb.TextDocumentView(origin="/run", name="Run"),
                ),
                row_shares=[3, 3, 2],
            ),
            column_shares=[5, 3],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline="sensor_time"),
        auto_views=False,
        auto_layout=False,
    )


def send_layout(stream: rr.RecordingStream, layout: _Layout) -> None:
    """Write a layout to ``stream``, and close the layout's own stream.

    Left open, the layout's stream would keep two threads forever.
    """
    stream.send_blueprint(layout)
    if layout.stream is not None:
        layout.stream.disconnect()


def _one_of(views: Sequence[Any]) -> Any:
    return views[0] if len(views) == 1 else rrb.Tabs(*views)


def _scene_view(entity: str, title: str, eye: Eye) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=entity,
        name=title,
        background=_BACKGROUND,
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=rrb.EyeControls3D(
            position=eye.position, look_target=eye.target, eye_up=eye.up
        ),
    )


def _track_tabs(tracks: Sequence[TrackView]) -> rrb.Tabs:
    """Return a tab for each of the longest tracks, since stacked plots are too low to read."""
    longest = sorted(tracks, key=lambda track: -track.frames)[:_MOST_TRACKS]
    views = [_track_view(track) for track in tracks if track in longest]
    return rrb.Tabs(*views, name="Posterior so far")


def _track_view(track: TrackView) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin=track.entity,
        name=track.title,
        axis_x=_TIME,
        axis_y=rrb.ScalarAxis(range=(-0.08, 1.08), zoom_lock=True),
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )
