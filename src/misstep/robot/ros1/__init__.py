"""ROS 1: the paper's three nodes, with rospy and a roscore.

    ┌────────────┐  joint states   ┌────────────┐  explore: state   ┌─────────────┐
    │            │ ──────────────▶ │            │ ────────────────▶ │             │
    │ simulation │                 │ controller │                   │ exploration │
    │            │ ◀────────────── │            │ ◀──────────────── │             │
    └────────────┘  effort command └────────────┘  action           └─────────────┘
                                    bags, demonstrations             the run

rospy is Debian's, not PyPI's: `misstep.robot.ros1.environment` finds it.
"""
