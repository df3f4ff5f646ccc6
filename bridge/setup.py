"""The files that ROS looks for beside the Python package; all else stands in setup.cfg."""

from glob import glob

from setuptools import setup
from setuptools.command.build_py import build_py

SHARE = "share/whill_bridge"


class BuildModules(build_py):
    """Leaves this file out of the package, whose folder it lies in."""

    def find_package_modules(self, package: str, package_dir: str) -> list:
        return [found for found in super().find_package_modules(package, package_dir) if found[1] != "setup"]


setup(cmdclass={"build_py": BuildModules}, data_files=[
    ("share/ament_index/resource_index/packages", ["resource/whill_bridge"]),
    (SHARE, ["package.xml", "fastdds.xml"]),
    (f"{SHARE}/launch", sorted(glob("launch/*.launch.py"))),
    (f"{SHARE}/config", sorted([*glob("config/*.yaml"), *glob("config/*.rviz"), *glob("config/*.json")])),
    (f"{SHARE}/systemd", sorted(glob("systemd/*.service"))),
])
