"""Builds the maker's message package whill_msgs where it is absent: pip's rosidl generates it, gcc compiles it.

On a robot colcon builds it from the maker's sources. The fields are those of whill_msgs/msg/ModelCr2State.msg.
"""

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

PACKAGE = "whill_msgs"
IDL = """module whill_msgs { module msg { struct ModelCr2State {
  int32 battery_power; float battery_current;
  float right_motor_angle; float left_motor_angle; float right_motor_speed; float left_motor_speed;
  int32 power_on; int32 speed_mode_indicator; int32 error; int8 joy_front; int8 joy_side;
}; }; };
"""
PARTS = ("generator_c", "typesupport_fastrtps_c", "typesupport_introspection_c", "typesupport_c", "generator_py")
INIT = f"""import ctypes, pathlib
for part in {PARTS}:  # as ROS finds them by LD_LIBRARY_PATH
    ctypes.CDLL(str(pathlib.Path(__file__).parent / f"lib{PACKAGE}__rosidl_{{part}}.so"), mode=ctypes.RTLD_GLOBAL)
"""
GENERATE = """
import pathlib, sys
from rosidl_generator_c.cli import GenerateC
from rosidl_generator_py.cli import GeneratePython
from rosidl_typesupport_c.cli import GenerateCTypesupport
from rosidl_typesupport_fastrtps_c.cli import GenerateFastRTPSCTypesupport
from rosidl_typesupport_introspection_c.cli import GenerateIntrospectionCTypesupport

python = GeneratePython("py")
python._GeneratePython__typesupport_implementations = ["rosidl_typesupport_c"]
steps = [(GenerateC("c"), "include"), (GenerateCTypesupport("c"), "include"),
         (GenerateFastRTPSCTypesupport("fastrtps_c"), "include"),
         (GenerateIntrospectionCTypesupport("introspection_c"), "introspection"), (python, "python")]
for step, folder in steps:
    path = pathlib.Path(folder) / "whill_msgs"
    path.mkdir(parents=True, exist_ok=True)
    step.generate("whill_msgs", ["msg/ModelCr2State.idl"], [], path.resolve())
"""


def can_build():
    """Whether generators and compilers are here."""
    return all(map(shutil.which, ("gcc", "g++"))) and importlib.util.find_spec("rosidl_generator_py") is not None


def build(folder):
    """Build the package below a folder; return the path to put on PYTHONPATH."""
    import numpy

    (folder / "msg").mkdir(parents=True)
    (folder / "msg" / "ModelCr2State.idl").write_text(IDL)
    prefix = Path(sys.prefix)
    subprocess.run([sys.executable, "-c", GENERATE], check=True, cwd=folder, capture_output=True,
                   env={**os.environ, "AMENT_PREFIX_PATH": str(prefix)})
    package = folder / "python" / PACKAGE
    include = [f"-I{path}" for path in (folder / "include", folder / "introspection", prefix / "include",
                                        *(prefix / "include").iterdir(), sysconfig.get_path("include"),
                                        numpy.get_include())]
    detail = folder / "include" / PACKAGE / "msg" / "detail"
    sources = {
        "generator_c": sorted(detail.glob("*.c")),
        "typesupport_fastrtps_c": sorted(detail.glob("*.cpp")),
        "typesupport_introspection_c": sorted((folder / "introspection" / PACKAGE / "msg" / "detail").glob("*.c")),
        "typesupport_c": sorted(detail.parent.glob("*.cpp")),
        "generator_py": sorted((package / "msg").glob("*_s.c")),
        "python": [package / f"_{PACKAGE}_s.ep.rosidl_typesupport_c.c"],
    }
    libraries = ["rosidl_runtime_c", "rcutils", "rmw", "fastcdr", "rosidl_typesupport_c",
                 *(f"rosidl_typesupport_{kind}" for kind in ("fastrtps_c", "fastrtps_cpp", "introspection_c"))]
    built = []
    for part, files in sources.items():
        name = f"{PACKAGE}_s__rosidl_typesupport_c" if part == "python" else f"lib{PACKAGE}__rosidl_{part}"
        compiler = ["g++", "-std=c++17"] if files[0].suffix == ".cpp" else ["gcc"]
        subprocess.run([*compiler, "-fPIC", "-shared", *include, f"-Wl,-soname,{name}.so", "-o", package / f"{name}.so",
                        *files, f"-L{package}", f"-L{prefix / 'lib'}", *built, *(f"-l{name}" for name in libraries)],
                       check=True, capture_output=True)
        built.append(f"-l{PACKAGE}__rosidl_{part}")
    (package / "__init__.py").write_text(INIT)
    return folder / "python"
