"""Read a file as others publish it, MJCF or URDF, and what it includes, from beside or below it.

What a URDF has for other programs, and what it draws only, is left out; meshes and pictures are
named in it, but not opened here.
"""

import xml.etree.ElementTree as ElementTree
from pathlib import Path

from hector_jax.core.inputs import InputError, expect, short_repr
from hector_jax.robot.mjcf import check_elements, read_elements

_URDF_PARTS = ("link", "joint", "mujoco")  # of a robot; others are for other programs
_LINK_PARTS = ("inertial", "collision")
_MOST_INCLUDES = 100  # files


def read_whole(path: Path) -> ElementTree.Element:
    """Read all elements of a file, and of those that it includes.

    As in MuJoCo, each file can be included once, and its name is relative to the model.

    Raises:
        InputError: one line naming the file and what it must not include.
    """
    root, folder, seen = read_elements(path), path.parent.resolve(), [path.resolve()]
    if root.tag not in ("mujoco", "robot"):
        raise InputError(f"{path}: root element is <{root.tag[:40]}>, expected <mujoco> or <robot>")
    while found := [(p, x) for p in root.iter() for x in p if x.tag == "include"]:
        for parent, element in found:
            name = element.get("file", "")
            file = (folder / name).resolve()
            text = f"<include> of {short_repr(name)} is not accepted, expected a file beside the "
            text += "model, or below it, that is included once"
            expect(path, file.is_relative_to(folder) and file.is_file() and file not in seen, text)
            expect(path, len(seen) <= _MOST_INCLUDES, f"more than {_MOST_INCLUDES} includes")
            seen.append(file)
            i = list(parent).index(element)
            parent[i : i + 1] = list(read_elements(file))
    return root


def read_published(path: Path) -> ElementTree.Element:
    """Read the elements of a file that is safe to open with MuJoCo once its meshes are removed.

    Raises:
        InputError: one line naming the file and the first error in it.
    """
    root = read_whole(path)
    if root.tag == "robot":
        root[:] = [part for part in root if part.tag in _URDF_PARTS]
        for link in root.findall("link"):
            link[:] = [part for part in link if part.tag in _LINK_PARTS]
    check_elements(path, root)
    return root
