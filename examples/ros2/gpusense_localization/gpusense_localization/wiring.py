"""Pieces of ROS that both nodes use."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy


def latched() -> QoSProfile:
    """Return the quality of service of topics whose last message newcomers get."""
    return QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE)


def diagnostic_array(fields: dict[str, Any], stamp: Any) -> DiagnosticArray:
    """Return the message of one status.

    Args:
        fields: The fields of the status, see :func:`gpusense_localization.diagnostics.status_fields`.
        stamp: builtin_interfaces/Time of the message.
    """
    status = DiagnosticStatus(name=fields["name"], hardware_id=fields["hardware_id"], message=fields["message"])
    status.level = bytes([fields["level"]])
    status.values = [KeyValue(**pair) for pair in fields["values"]]
    array = DiagnosticArray(status=[status])
    array.header.stamp = stamp
    return array
