"""Planner and correction as a node of ROS 2: odometry comes in, velocities go out.

    python examples/deploy/ros2_node.py --policy policy.onnx --sha256 CHECKSUM

It needs a sourced ROS 2 (``rclpy``, ``geometry_msgs``, ``nav_msgs``), and what agent.py needs. It
was never run under ROS 2: the tests import it with stand-ins for these packages, give it messages,
and look at what it sends.

    /odom       nav_msgs/Odometry          in: the state, at least once a tick
    /goal_pose  geometry_msgs/PoseStamped  in: where to
    /cmd_vel    geometry_msgs/Twist        out: the action; SAFE without a goal, or without a state
                                           for WATCHDOG ticks
"""

from __future__ import annotations

import argparse
import math

import rclpy
from agent import Agent, load, make
from geometry_msgs.msg import PoseStamped, Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node

WATCHDOG = 2  # ticks without a state, after which the robot is stopped
SAFE = (0.0, 0.0)  # it stands still


class ActionFlowNode(Node):
    """Acts at a fixed rate on the newest odometry.

    Args:
        agent: the policy.
        tick: s, the time step of its model.
    """

    def __init__(self, agent: Agent, tick: float) -> None:
        super().__init__("action_flow")
        self.agent, self.pose, self.goal, self.silent = agent, None, None, 0
        self.follows = False  # does the next state follow from an action of the agent?
        self.publisher = self.create_publisher(Twist, "cmd_vel", 1)
        self.create_subscription(Odometry, "odom", self.on_odometry, 1)
        self.create_subscription(PoseStamped, "goal_pose", self.on_goal, 1)
        self.create_timer(tick, self.on_tick)

    def on_odometry(self, message: Odometry) -> None:
        """Keep the newest pose, if it is one."""
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        pose = (place.x, place.y, 2.0 * math.atan2(turn.z, turn.w))
        if all(map(math.isfinite, pose)):
            self.pose = pose

    def on_goal(self, message: PoseStamped) -> None:
        """Keep the goal."""
        self.goal = [message.pose.position.x, message.pose.position.y]

    def on_tick(self) -> None:
        """Send an action for the newest pose; without one, the last action stands for a tick."""
        pose, self.pose = self.pose, None
        self.silent = 0 if pose else self.silent + 1
        if pose and self.goal:
            self.send(self.agent.act(pose, self.goal, self.follows))
            self.follows = True
            return
        self.follows = False
        if self.silent >= WATCHDOG or not self.goal:
            self.send(SAFE)

    def send(self, action: list[float]) -> None:
        """Publish a velocity."""
        message = Twist()
        message.linear.x, message.angular.z = action
        self.publisher.publish(message)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", help="a file of afm-rl-export")
    parser.add_argument("--sha256", help="its checksum, as afm-rl-export printed it")
    parser.add_argument("--tick", type=float, default=0.2, help="s, the time step of the model")
    asked = parser.parse_args()
    rclpy.init()
    node = ActionFlowNode(load(asked.policy, asked.sha256) if asked.policy else make(), asked.tick)
    try:
        rclpy.spin(node)
    finally:
        node.send(SAFE)
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
