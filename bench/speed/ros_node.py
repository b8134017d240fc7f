"""The node of ``gpusense ros`` inside ROS 2 against the same filter offline: error, delay, scans, processor, memory.

Run it in an environment that ``.ci/ros`` made, with gpusense on the path. Recordings are played in real time and
faster; the delay is the time from a scan to its pose.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import rclpy
import recordings
from common import make_parser, note, parse, publish, table
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.executors import ExternalShutdownException
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import LaserScan
from tf2_msgs.msg import TFMessage

import gpusense as gs
from gpusense.ros.conversions import fill, pose_matrix, transform_fields
from gpusense.ros.localizer import Localizer

COLUMNS = (
    "recording", "rate", "particles", "scans counted", "node - reference [cm]", "offline - reference [cm]",
    "node - offline [cm]", "delay: median, 95 %, largest [ms]", "of a core [%]", "memory [MB]",
)  # fmt: skip
# Time between scans in the recording [s].
PERIODS = {"olin": 0.13, "jarvis-s3000": 0.08, "simulated": 0.25}


def simulated(folder):
    """Return a recording of a generated office."""
    names = [str(folder / name) for name in ("run.bag", "map.yaml", "truth.tum")]
    command = ["simulate", "--world", "office", "--scans", "200", "--view", "270", "--mount", "0.2", "0", "0"]
    subprocess.run([sys.executable, "-m", "gpusense", *command, "--log-out", names[0], "--map-out", names[1], "--tum",
                    names[2]], check=True, stdout=subprocess.DEVNULL)  # fmt: skip
    rows = np.loadtxt(names[2])
    truth = np.column_stack([rows[:, 1:3], 2 * np.arctan2(rows[:, 6], rows[:, 7])])
    scans = list(gs.read_log(names[0]))
    events = [
        recordings.Event(0, scan.ranges, np.array(scan.odometry), pose) for scan, pose in zip(scans, truth, strict=True)
    ]
    return recordings.Recording("simulated", [(gs.read_map(names[1]), scans[0].scanner)], events)


def parameters(recording, particles):
    """Return nav2_amcl's parameters; every scan counts."""
    x, y, yaw = recording.events[0].truth.tolist()
    return {
        "max_particles": particles, "min_particles": particles if particles >= 100_000 else 500, "sigma_hit": 0.1,
        "update_min_d": -1.0,
        "set_initial_pose": True, "initial_pose.x": x, "initial_pose.y": y, "initial_pose.yaw": yaw,
        "laser_max_range": -1.0,
    }  # fmt: skip


def messages(recording):
    """Return the transform of the laser, and the transform and the scan of each event."""
    (_, scanner), period = recording.places[0], PERIODS[recording.name]
    bearings = scanner.bearings
    mount = stamped(TransformStamped(child_frame_id="laser"), 0.0, "base_footprint")
    fill(mount.transform, transform_fields(scanner.mount))
    made = []
    for k, event in enumerate(recording.events):
        moved = stamped(TransformStamped(child_frame_id="base_footprint"), 1 + k * period, "odom")
        fill(moved.transform, transform_fields(tuple(map(float, event.odometry))))
        scan = stamped(LaserScan(range_min=scanner.range_min, range_max=scanner.range_max), 1 + k * period, "laser")
        scan.angle_min, scan.angle_increment = float(bearings[0]), float(bearings[1] - bearings[0])
        scan.ranges = event.ranges.astype(np.float32).tolist()
        made.append((moved, scan))
    return mount, made


def stamped(message, time, frame):
    message.header.stamp.sec, message.header.frame_id = math.floor(time), frame
    message.header.stamp.nanosec = round((time - math.floor(time)) * 1e9)
    return message


def offline(recording, made, values, backend):
    """Return the poses of the same filter without ROS."""
    localizer = Localizer(gs.compat.from_nav2(values), backend=backend)
    grid, scanner = recording.places[0]
    localizer.set_map(grid)
    poses = []
    for event, (_, scan) in zip(recording.events, made, strict=True):
        localizer.update(scan, tuple(map(float, event.odometry)), pose_matrix(scanner.mount))
        poses.append(np.array(localizer.estimate.pose))
    return np.array(poses)


def online(recording, made, mount, values, backend, rate, folder):
    """Play the recording to the node; return poses, delays [s], share of a core, and memory [MB] by scan or once."""
    gs.write_map(recording.places[0][0], folder / "map.yaml")
    given = [part for name, value in values.items() for part in ("-p", f"{name}:={str(value).lower()}")]
    process = subprocess.Popen([sys.executable, "-m", "gpusense", "ros", "--map", str(folder / "map.yaml"),
                                "--backend", backend, "--ros-args", *given])  # fmt: skip
    node = rclpy.create_node("player")
    poses, came, sent = {}, {}, {}

    def take(message):
        key = message.header.stamp.sec, message.header.stamp.nanosec
        came[key], place = time.perf_counter(), message.pose.pose
        poses[key] = place.position.x, place.position.y, 2 * math.atan2(place.orientation.z, place.orientation.w)

    node.create_subscription(PoseWithCovarianceStamped, "amcl_pose", take, 100)
    kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    static, moving = node.create_publisher(TFMessage, "/tf_static", kept), node.create_publisher(TFMessage, "/tf", 100)
    scans = node.create_publisher(LaserScan, "scan", 100)
    static.publish(TFMessage(transforms=[mount]))
    executor = rclpy.executors.SingleThreadedExecutor()
    executor.add_node(node)
    ended = threading.Event()

    def spin():
        while not ended.is_set():
            try:
                executor.spin_once(timeout_sec=0.1)
            except ExternalShutdownException:
                return

    thread = threading.Thread(target=spin)
    thread.start()
    while not all(one.get_subscription_count() for one in (static, moving, scans)):
        time.sleep(0.1)
    time.sleep(2.0)
    spent, begin = used(process.pid), time.perf_counter()
    for k, (moved, scan) in enumerate(made):
        time.sleep(max(0.0, begin + k * PERIODS[recording.name] / rate - time.perf_counter()))
        sent[scan.header.stamp.sec, scan.header.stamp.nanosec] = time.perf_counter()
        moving.publish(TFMessage(transforms=[moved]))
        scans.publish(scan)
    lasted = time.perf_counter() - begin
    last = -1
    while last != len(poses):
        last = len(poses)
        time.sleep(2.0)
    share = (used(process.pid) - spent) / lasted
    memory = next(int(line.split()[1]) / 1024 for line in Path(f"/proc/{process.pid}/status").read_text().splitlines()
                  if line.startswith("VmHWM"))  # fmt: skip
    process.send_signal(signal.SIGINT)
    process.wait()
    ended.set()
    thread.join()
    node.destroy_node()
    found = np.array([poses.get(key, (math.nan,) * 3) for key in sent])
    return found, [came[key] - sent[key] for key in came if key in sent], share, memory


def used(pid):
    """Return the processor time of a process [s]."""
    parts = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(parts[11]) + int(parts[12])) / os.sysconf("SC_CLK_TCK")


def apart(first, second):
    """Return the median and the largest distance as text [cm]."""
    distance = 100 * np.hypot(*(first - second)[:, :2].T)
    return f"{np.nanmedian(distance):.1f}, {np.nanmax(distance):.1f}"


def main():
    parser = make_parser(__doc__, backend="auto", data=True, seed=False)
    parser.add_argument("--rates", type=float, nargs="+", default=[1.0, 5.0, 10.0])
    parser.add_argument("--names", nargs="+", default=list(PERIODS))
    parser.add_argument("--particles", type=int, nargs="+", default=[2000])
    parser.add_argument("--scans", type=int, default=150)
    args = parse(parser)
    rclpy.init()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in args.names:
            made = simulated(Path(folder)) if name == "simulated" else recordings.load(name)
            known = [event for event in made.events if event.scanner == 0 and np.isfinite(event.truth).all()]
            recording = recordings.Recording(name, made.places, known[: args.scans])
            truth = np.array([event.truth for event in recording.events])
            mount, sent = messages(recording)
            for particles in args.particles:
                values = parameters(recording, particles)
                alone = offline(recording, sent, values, args.backend)
                for rate in args.rates:
                    poses, delays, share, memory = online(
                        recording, sent, mount, values, args.backend, rate, Path(folder)
                    )
                    quantiles = 1000 * np.quantile(delays, (0.5, 0.95, 1.0))
                    rows.append(dict(zip(COLUMNS, (
                        name, rate, particles, f"{np.isfinite(poses[:, 0]).sum()} of {len(poses)}", apart(poses, truth),
                        apart(alone, truth), apart(poses, alone), ", ".join(f"{q:.0f}" for q in quantiles),
                        round(100 * share), round(memory),
                    ), strict=True)))  # fmt: skip
                    note(str(rows[-1]))
    rclpy.shutdown()
    publish(__file__, args, table(COLUMNS, [list(row.values()) for row in rows]), {"rows": rows})


if __name__ == "__main__":
    main()
