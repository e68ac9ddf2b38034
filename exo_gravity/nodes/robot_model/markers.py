"""Shapes of `core.view.scene` as visualization_msgs/Marker."""

from __future__ import annotations

from collections.abc import Iterable

from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from exo_gravity.core.view.scene import ARROW, LINE, SPHERE, TEXT, Shape
from exo_gravity.core.view.urdf import ROOT

KINDS = {ARROW: Marker.ARROW, LINE: Marker.LINE_STRIP, SPHERE: Marker.SPHERE, TEXT: Marker.TEXT_VIEW_FACING}
LIFETIME = Duration(nanosec=500_000_000)  # a marker that is no longer sent disappears


def marker_array(shapes: Iterable[tuple[str, Shape]], stamp: Time) -> MarkerArray:
    """Return the markers of (owner, shape): an owner is a side, or '' for what both arms share."""
    markers, counts = [], dict[str, int]()
    for owner, shape in shapes:
        group = f"{owner}/{shape.group}" if owner else shape.group
        counts[group] = counts.get(group, -1) + 1
        markers.append(_marker(group, counts[group], shape, stamp))
    return MarkerArray(markers=markers)


def _marker(group: str, number: int, shape: Shape, stamp: Time) -> Marker:
    marker = Marker(ns=group, id=number, type=KINDS[shape.kind], action=Marker.ADD, lifetime=LIFETIME, text=shape.text)
    marker.header.stamp, marker.header.frame_id = stamp, ROOT
    marker.color = ColorRGBA(**dict(zip("rgba", shape.colour, strict=True)))
    marker.pose.orientation.w = 1.0
    points = [Point(x=x, y=y, z=z) for x, y, z in shape.points.tolist()]
    scale = marker.scale
    if shape.kind in (LINE, ARROW):
        marker.points = points
        scale.x = shape.size
        if shape.kind == ARROW:  # x: diameter of the shaft, y: of the head
            scale.y = 2 * shape.size
    else:
        marker.pose.position = points[0]
        scale.x = scale.y = scale.z = shape.size
    return marker
