"""Install the node."""

from setuptools import setup

NAME = "gpusense_localization"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/config", ["config/amcl.yaml"]),
        (f"share/{NAME}/launch", ["launch/localize.launch.py"]),
    ],
    install_requires=["setuptools", "gpusense"],
    license="Apache-2.0",
    entry_points={
        "console_scripts": [
            f"{name} = gpusense.ros.nodes.{module}:main"
            for name, module in (("localize", "localization"), ("watch", "watching"))
        ]
    },
)
