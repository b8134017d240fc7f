"""Names of nodes and parameters in parameter files of ROS 2."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

import gpusense as gs

from_nav2 = gs.compat.from_nav2


def test_one_of_several_nodes_is_chosen() -> None:
    file = {
        "/**": {"ros__parameters": {"use_sim_time": True, "z_hit": 0.7, "z_rand": 0.3}},
        "robot1": {"amcl": {"ros__parameters": {"max_particles": 700}}},
        "/robot2/amcl": {"ros__parameters": {"max_particles": 800, "z_hit": 0.9}},
        "other": {"ros__parameters": {"max_particles": 900}},
    }
    for node, most, hit in (("robot1/amcl", 700, 0.7), ("/robot2/amcl", 800, 0.9), ("other", 900, 0.7)):
        options = from_nav2(file, node=node)
        assert (options.particles[1], options.weights.z_hit, options.ignored) == (most, hit, ())
    for node in (None, "amcl"):
        with pytest.raises(ValueError, match=r"node: must name one of \['/robot1/amcl', '/robot2/amcl'\] in source"):
            from_nav2(file, node=node)
    with pytest.raises(ValueError, match=r"node: must be a node of source, one of .*'/other'.*, got 'amcl3'"):
        from_nav2({name: own for name, own in file.items() if name != "/**"}, node="amcl3")
    assert from_nav2({"amcl": file["other"], "robot": {"amcl": file["/**"]}}, node="/amcl").particles[1] == 900
    assert from_nav2({"/**": file["/**"]}).ignored == ("use_sim_time",)
    with pytest.raises(ValueError, match="node: must be None where source has the parameters themselves"):
        from_nav2({"z_hit": 0.5}, node="amcl")
    with pytest.raises(TypeError, match="node: must be a string"):
        from_nav2(file, node=1)  # type: ignore[arg-type]


def node_of(**values: Any) -> dict[str, Any]:
    return {"ros__parameters": values}


# rclcpp replaces "/*" by "(/\\w+)" in the name of a node, and matches the node's full name by this expression.
@pytest.mark.parametrize("pattern", [
    "/**", "/*", "*", "/*/amcl", "/**/amcl", "/robot2/*", "/robot2/**", "/robot2/*/amcl",
    "/robot2/amcl/*", "/robot2/amcl/**", "/**/robot2/**", "/*/*", "/*/*/*", "/**/*", "/**/x/*", "/**/**", "/robot/**",
    "/**/*/amcl", "/fleet/*/amcl", "/fleet/**", "/*/robot2/*", "/**/robot2/*/amcl",
])  # fmt: skip
@pytest.mark.parametrize("node", ["/robot2/amcl", "/amcl", "/fleet/robot2/amcl"])
def test_wildcards_match_as_in_rclcpp(pattern: str, node: str) -> None:
    name = pattern if pattern.startswith("/") else f"/{pattern}"
    if re.fullmatch(name.replace("/*", r"(/\w+)"), node):
        assert from_nav2({pattern: node_of(max_beams=33)}, node=node).max_beams == 33
    else:
        with pytest.raises(ValueError, match="node: must be a node of source"):
            from_nav2({pattern: node_of(max_beams=33)}, node=node)


def test_wildcards_are_merged_in_the_order_of_the_file(tmp_path: Path) -> None:
    wild = {"/**": node_of(max_beams=1, z_hit=0.7), "robot2": {"*": node_of(max_beams=2)}}
    assert from_nav2(wild, node="/robot2/amcl").max_beams == 2
    assert from_nav2(dict(reversed(wild.items())), node="/robot2/amcl").max_beams == 1
    exact = from_nav2(wild | {"/robot2/amcl": node_of(max_beams=3)})
    assert (exact.max_beams, exact.weights.z_hit) == (3, 0.7)
    with pytest.warns(UserWarning, match="/robot2/amcl: max_beams is also set under a wildcard further down"):
        assert from_nav2({"/robot2/amcl": node_of(max_beams=3)} | wild).max_beams == 3
    with pytest.raises(ValueError, match=r"node: must be a node of source, one of \['/robot2/\*\*'\], got None"):
        from_nav2({"/robot2/**": node_of(max_beams=3)})
    hostile = tmp_path / "hostile.yaml"
    hostile.write_text("/**" * 30 + "/x: {ros__parameters: {max_beams: 3}}\n")
    with pytest.raises(ValueError, match="node: must be a node"):
        from_nav2(hostile, node="/a" * 60)


@pytest.mark.parametrize("old, new", [
    ("odom_model_type", "robot_model_type"), ("laser_z_hit", "z_hit"), ("laser_max_beams", "max_beams"),
    ("odom_alpha5", "alpha5"), ("kld_err", "pf_err"), ("initial_pose_a", "initial_pose.yaw"),
])  # fmt: skip
def test_names_of_ros_1_are_named(old: str, new: str) -> None:
    for flat in ({old: 1}, {old: 1, "min_particles": 100}, {"amcl": {old: 1}}):
        with pytest.raises(ValueError, match=rf"source: must have amcl's names in ROS 2, .* {old} \(now {new}\)"):
            from_nav2(flat)
    with pytest.warns(UserWarning, match=rf"names of ROS 1's amcl have no effect in ROS 2: {old} \(now {new}\)"):
        assert from_nav2({"amcl": node_of(**{old: 1})}).ignored == (old,)
