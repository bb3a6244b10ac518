"""The services of the package misstep_ros: built by catkin, or else here from the same files."""

import importlib.util
import sys
from functools import cache
from importlib.resources import files
from types import ModuleType
from typing import Any

from misstep.robot.ros1.environment import import_ros
from misstep.robot.ros1.quick import quick_explore

PACKAGE = "misstep_ros"


@cache
def service_type(name: str) -> Any:
    """Return a service type, ``"Explore"``, with its request and response.

    That of a sourced catkin workspace, where it has one; the checksum of both is the same.

    Raises
    ------
    MisstepError
        If ROS 1 is not installed.
    """
    kind = generated_type(name)
    return quick_explore(kind) if name == "Explore" else kind


def generated_type(name: str) -> Any:
    """Return a service type as genpy makes it."""
    if importlib.util.find_spec(PACKAGE) is not None:
        return getattr(import_ros(f"{PACKAGE}.srv"), name)
    module = ModuleType(f"{PACKAGE}.srv._{name}")
    sys.modules[module.__name__] = module  # genpy looks up the module of a message
    exec(compile(_source(name), module.__name__, "exec"), module.__dict__)  # noqa: S102 - genpy's
    return getattr(module, name)


def _source(name: str) -> str:
    """Return what genpy makes of a file: the Python source of the service."""
    genmsg, generator = import_ros("genmsg"), import_ros("genpy.generator")
    text = files("misstep.robot.ros1").joinpath(f"srv/{name}.srv").read_text(encoding="utf-8")
    context = genmsg.MsgContext.create_default()
    full_name = f"{PACKAGE}/{name}"
    spec = genmsg.msg_loader.load_srv_from_string(context, text, full_name)
    return "\n".join(generator.srv_generator(context, spec, {}))
