"""Command line: ``raystream render | compare | devices``."""

import argparse
import inspect
import pathlib
import re
import sys

import pyopencl as cl
from tqdm import tqdm

from raystream import image as images
from raystream import scenes, tables
from raystream._version import __version__
from raystream.camera import Camera
from raystream.device import default_device, devices
from raystream.errors import BuildError, DeviceError
from raystream.light import PointLight
from raystream.renderer import PRIMARY_VISIBILITY, Renderer, parse_method
from raystream.scene import load_scene
from raystream.tracer import AUTO, methods

# Procedural scenes by name; "name:argument" passes a number or a variant.
PROCEDURAL = {
    "demo": scenes.demo,
    "cornell": scenes.cornell,
    "bumpy_mirror": scenes.bumpy_mirror,
    "rings": scenes.rings,
    "gears": scenes.gears,
    "balls": scenes.balls,
    "mountain": scenes.mountain,
    "room": scenes.room,
    "toys": scenes.toys,
    "meadow": scenes.meadow,
}
_VECTOR_OPTIONS = ("--eye", "--target", "--up", "--light", "--mirror-ball")
_BAD_INPUT = 2
_EXPECTED = (ValueError, TypeError, OSError, DeviceError, BuildError, MemoryError, cl.Error)

_SCENE_HELP = (
    "a file that trimesh reads (OBJ, PLY, STL, OFF, GLB, ...) or a procedural scene: "
    + ", ".join(PROCEDURAL)
    + "; rings:3 passes an argument"
)
_METHOD_HELP = "options of a method follow it: rsh:arity=8:levels=2"
_RENDER_EXAMPLES = """examples:
  raystream render demo -o demo.png
  raystream render kitchen.glb -o kitchen.png --size 1024x768 --mirror 'floor*' --samples 4
  raystream render bunny.ply -o bunny.exr --eye 0,0.11,0.35 --target -0.017,0.11,0 --light 1,2,1
  raystream render sponza.obj -o atrium.png --eye -12,4,0 --target 0,3,1 --mirror-ball 0,2,0,1.5
"""
_COMPARE_EXAMPLES = """examples:
  raystream compare demo --methods dual,crsh,embree -o demo
  raystream compare bunny.ply --methods rsh,brute,embree --mirror '*'
  raystream compare cornell --methods rsh:arity=8:levels=2,rsh --counts
"""


def main(arguments=None):
    """Run the command line; returns the exit code: 0, 1 a failed check, 2 bad input."""
    options = _parser().parse_args(_joined(sys.argv[1:] if arguments is None else arguments))
    try:
        return options.run(options)
    except _EXPECTED as error:
        print(f"raystream: {str(error).splitlines()[0]}", file=sys.stderr)
        return _BAD_INPUT


def _joined(arguments):
    """``--eye -1,2,3`` as ``--eye=-1,2,3``: argparse takes a leading minus for an option."""
    joined = []
    for argument in arguments:
        if joined and joined[-1] in _VECTOR_OPTIONS:
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


class _Parser(argparse.ArgumentParser):
    def error(self, message):
        """One line, without the usage."""
        self.exit(_BAD_INPUT, f"{self.prog}: {message}\n")


def _parser():
    parser = _Parser(
        prog="raystream", description="Ray queries and Whitted rendering in OpenCL."
    )
    parser.add_argument("--version", action="version", version=__version__)
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    _add_render(commands)
    _add_compare(commands)
    listing = commands.add_parser("devices", help="list the OpenCL devices")
    listing.set_defaults(run=_devices)
    return parser


def _add_render(commands):
    command = commands.add_parser(
        "render",
        help="render a scene into a picture",
        epilog=_RENDER_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_scene(command)
    command.add_argument("-o", "--output", required=True, help="picture: .png .jpg .exr .npy")
    command.add_argument(
        "--method",
        default=AUTO,
        help=f"one of {', '.join(methods())}, {AUTO} (default: %(default)s); {_METHOD_HELP}",
    )
    command.add_argument("--samples", type=int, default=1, help="samples per pixel")
    command.add_argument(
        "--primary",
        choices=PRIMARY_VISIBILITY,
        default="raster",
        help="find what the camera sees by rasterisation or by the method's rays",
    )
    command.add_argument(
        "--verify",
        action="store_true",
        help="check every ray against Embree and the picture against the reference renderer",
    )
    command.set_defaults(run=_render)


def _add_compare(commands):
    command = commands.add_parser(
        "compare",
        help="time methods, and check them against Embree",
        epilog=_COMPARE_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    _add_scene(command)
    command.add_argument(
        "--methods",
        default="dual,crsh,rsh,embree",
        help=f"of {', '.join(methods())} and embree, with commas between (default: %(default)s); "
        + _METHOD_HELP,
    )
    command.add_argument(
        "--counts",
        action="store_true",
        help="print the tests of every level by kind of ray, their sums and the stage times",
    )
    command.add_argument("-o", "--output", help="folder for the pictures")
    command.set_defaults(run=_compare)


def _add_scene(command):
    command.add_argument("scene", help=_SCENE_HELP)
    add = command.add_argument
    add("--size", type=_size, default=(512, 512), metavar="WIDTHxHEIGHT")
    add("--bounces", type=int, default=2, help="generations of reflected and refracted rays")
    add("--eye", type=_vector, metavar="X,Y,Z", help="camera position (default: the scene's)")
    add("--target", type=_vector, metavar="X,Y,Z", help="point that the camera looks at")
    add("--up", type=_vector, default=None, metavar="X,Y,Z",
        help="up axis; without --eye and --target the camera is fitted to the scene")
    add("--fov", type=float, default=None, help="vertical field of view in degrees")
    add("--light", type=_vector, action="append", metavar="X,Y,Z",
        help="a white point light in place of the scene's; may be repeated")
    add("--mirror", action="append", default=[], metavar="PATTERN",
        help="make meshes or materials of that name mirrors; may be repeated")
    add("--glass", action="append", default=[], metavar="PATTERN",
        help="make meshes or materials of that name glass; may be repeated")
    add("--mirror-ball", type=_ball, action="append", default=[], metavar="X,Y,Z,R",
        help="add a mirror sphere; may be repeated")
    add("--smooth", action="store_true", help="smooth normals for meshes that have none")
    add("--on-invalid", choices=("raise", "drop"), default="raise",
        help="triangles with vertices that are not finite")  # fmt: skip


def _numbers(text, count):
    parts = text.split(",")
    if len(parts) != count:
        raise argparse.ArgumentTypeError(f"need {count} numbers with commas, got {text!r}")
    try:
        return tuple(float(part) for part in parts)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"need {count} numbers with commas, got {text!r}"
        ) from None


def _vector(text):
    return _numbers(text, 3)


def _ball(text):
    return _numbers(text, 4)


def _size(text):
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit()):
        raise argparse.ArgumentTypeError(f"need WIDTHxHEIGHT, got {text!r}")
    return int(width), int(height)


def _scene(options):
    scene = _load(options)
    for x, y, z, radius in options.mirror_ball:
        scene.add(scenes.mirror_ball((x, y, z), radius))
    for pattern in options.mirror:
        scene.mirror(pattern)
    for pattern in options.glass:
        scene.glass(pattern)
    if options.light:
        scene.set_lights([PointLight(position) for position in options.light])
    return scene


def _load(options):
    name, _, argument = options.scene.partition(":")
    if name in PROCEDURAL and not pathlib.Path(options.scene).is_file():
        if not argument:
            return PROCEDURAL[name]()
        if not inspect.signature(PROCEDURAL[name]).parameters:
            raise ValueError(f"{options.scene}: scene {name!r} takes no argument")
        return PROCEDURAL[name](int(argument) if argument.isdigit() else argument)
    return load_scene(options.scene, smooth=options.smooth, on_invalid=options.on_invalid)


def _camera(options, scene):
    """The scene's camera with what the options change; fitted anew for another up axis."""
    given = scene.camera
    if options.up is not None and options.eye is None and options.target is None:
        fov_y = given.fov_y if options.fov is None else options.fov
        return Camera.fit(scene.bounds, options.up, fov_y)
    return Camera.look_at(
        given.eye if options.eye is None else options.eye,
        given.target if options.target is None else options.target,
        given.up if options.up is None else options.up,
        given.fov_y if options.fov is None else options.fov,
    )


def _render(options):
    path = images.check_suffix(options.output)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"{path}: no such folder")
    method, method_options = parse_method(options.method, (*methods(), AUTO))
    scene = _scene(options)
    camera = _camera(options, scene)
    renderer = Renderer(scene, method, **method_options)
    with tqdm(total=options.samples, unit="sample", disable=None) as bar:
        frame = renderer.render(
            camera,
            options.size,
            options.bounces,
            samples=options.samples,
            progress=lambda _done, _all: bar.update(),
            primary=options.primary,
        )
    frame.save(options.output)
    kind = "rays" if options.primary == "trace" else "secondary rays"
    print(f"{options.output}: {frame.statistics.rays} {kind}, {options.method}")
    if not options.verify:
        return 0
    results, _ = _results([(options.method, method, method_options)], options, scene, camera)
    return _failed(results)


def _compare(options):
    from raystream import compare  # Embree and scikit-image are needed here only

    names = [name.strip() for name in options.methods.split(",") if name.strip()]
    if not names:
        known = ", ".join((*methods(), compare.EMBREE))
        raise ValueError(f"--methods: need some of {known}, got {options.methods!r}")
    chosen = [compare.as_method(name) for name in names]
    scene = _scene(options)
    results, reference = _results(chosen, options, scene, _camera(options, scene))
    if options.counts:
        print("\n".join(["", *tables.count_tables(results)]))
    if options.output is not None:
        _save_pictures(pathlib.Path(options.output), results, reference)
    return _failed(results)


def _results(chosen, options, scene, camera):
    """Compare and print the table; the results and the reference picture."""
    from raystream import compare

    steps = 1 + sum(1 if method == compare.EMBREE else 2 for _, method, _ in chosen)
    with tqdm(total=steps, disable=None) as bar:

        def progress(line):
            bar.set_description(line)
            bar.update()

        results, reference = compare.compare(
            scene, chosen, camera, options.size, options.bounces, progress
        )
    print("\n".join(tables.table(results)))
    return results, reference


def _failed(results):
    """Name the methods whose check failed; the exit code: 1 where there are some."""
    failed = [result.method for result in results if not result.ok]
    if failed:
        print(f"raystream: not within the rules: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _save_pictures(folder, results, reference):
    from raystream import compare

    folder.mkdir(parents=True, exist_ok=True)
    images.save(folder / "reference.png", reference)
    for result in results:
        stem = re.sub(r"[^\w.+-]", "-", result.method)  # ":" and "=" are not for file names
        images.save(folder / f"{stem}.png", result.frame.image)
        difference = compare.difference_image(result.frame.image, reference)
        images.save(folder / f"{stem}-difference.png", difference)
    images.save(folder / "side-by-side.png", compare.side_by_side(results, reference))
    print(f"pictures in {folder}; differences are {compare.AMPLIFICATION} times amplified")


def _devices(_options):
    found = devices()
    if not found:
        default_device()  # raises the message that says what to install
    chosen = default_device()
    for device in found:
        mark = "*" if device == chosen else " "
        memory = device.global_mem_size / 2**30
        print(
            f"{mark} {device.name.strip()} | {device.platform.name} | {device.version.strip()} | "
            f"{device.max_compute_units} compute units, {memory:.1f} GiB"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
