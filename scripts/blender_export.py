"""blender_export.py: what only Blender reads, as a .glb for dar-bundle.

    blender --background --factory-startup --python scripts/blender_export.py -- INPUT [options]

    INPUT             .blend .fbx .bvh .abc .usd* .dae .obj .ply .stl .x3d .gltf .glb
    -o OUT.glb        default: INPUT with .glb instead of its suffix
    --rig FILE        a model with a skeleton, of any of the kinds above, that a .bvh moves: bones are matched by
                      name.  Without it a .bvh becomes sticks, one for each bone
    --frames A:B      default: the scene's, or those that the file's animation covers
    --fps N           default: the scene's, of a .bvh 1 / its frame time
    --merge           all that moves becomes one animation, as the scene plays.  Done by itself when several things
                      move; otherwise every action of the one that does is an animation with its name
    --bake            meshes frame by frame, as morph targets: whatever deforms them (simulations, lattices, drivers).
                      Done by itself for meshes that Alembic or USD moves.  Needs the same vertices in every frame

Runs in Blender 3.4, as Debian has it, and in 4.x.  Debian's lacks Alembic and USD; a build from blender.org has both.
Exit status 0: written; 1: Blender failed; 2: wrong usage or bad input.
"""

import argparse
import builtins
import os
import sys
import traceback

import bpy

OWN_MOTION = {"MESH_SEQUENCE_CACHE"}  # modifiers that move vertices and that glTF cannot say otherwise


class Refused(Exception):
    pass


def mend_blender():
    """Debian's Blender 3.4 meets a newer numpy and a newer Python than it was written for."""
    try:
        import numpy

        if "bool" not in numpy.__dict__:
            numpy.bool = bool  # the glTF reader asks for it
    except ImportError as e:
        raise Refused("Blender's glTF add-on needs numpy: install python3-numpy") from e

    def without_u(file, mode="r", *rest, _open=builtins.open, **more):
        return _open(file, mode.replace("U", "") if isinstance(mode, str) else mode, *rest, **more)

    if sys.version_info >= (3, 11):
        builtins.open = without_u  # the BVH reader opens with "rU"


def call(operator, **wanted):
    """Call with those arguments that this version of Blender knows."""
    known = operator.get_rna_type().properties.keys()
    if "FINISHED" not in operator(**{k: v for k, v in wanted.items() if k in known}):
        raise Refused(f"{operator.idname_py()} did not finish")


def operator_of(*names):
    """The first of the operators that exists: names change between versions."""
    for name in names:
        group, function = name.split(".")
        found = getattr(getattr(bpy.ops, group), function)
        try:
            found.get_rna_type()
            return found
        except KeyError:
            continue
    raise Refused(f"this Blender ({bpy.app.version_string}) has no {names[0]}")


def read(path):
    """Add what is in the file to the scene; .blend: replace the scene."""
    kind = os.path.splitext(path)[1].lower()
    if not os.path.isfile(path):
        raise Refused(f"{path}: no such file")
    if kind == ".blend":
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False)
    elif kind == ".fbx":
        call(operator_of("import_scene.fbx"), filepath=path)
    elif kind == ".bvh":
        call(operator_of("import_anim.bvh"), filepath=path, update_scene_fps=True, update_scene_duration=True,
             axis_forward="-Z", axis_up="Y")
    elif kind == ".abc":
        if not bpy.app.alembic.supported:
            raise Refused(f"{path}: this Blender is built without Alembic; one from blender.org has it")
        call(operator_of("wm.alembic_import"), filepath=path, set_frame_range=True, as_background_job=False)
    elif kind.startswith(".usd"):
        if not bpy.app.usd.supported:
            raise Refused(f"{path}: this Blender is built without USD; one from blender.org has it")
        call(operator_of("wm.usd_import"), filepath=path, set_frame_range=True)
    elif kind in (".gltf", ".glb"):
        call(operator_of("import_scene.gltf"), filepath=path)
    elif kind == ".dae":
        call(operator_of("wm.collada_import"), filepath=path)
    elif kind == ".obj":
        call(operator_of("wm.obj_import", "import_scene.obj"), filepath=path)
    elif kind == ".ply":
        call(operator_of("wm.ply_import", "import_mesh.ply"), filepath=path)
    elif kind == ".stl":
        call(operator_of("wm.stl_import", "import_mesh.stl"), filepath=path)
    elif kind == ".x3d":
        call(operator_of("import_scene.x3d"), filepath=path)
    else:
        raise Refused(f"{path}: found '{kind}', expected one of the suffixes in --help")


def of_type(kind):
    return [o for o in bpy.context.scene.objects if o.type == kind]


def select_only(objects):
    for o in bpy.context.view_layer.objects:
        o.select_set(o in objects)
    bpy.context.view_layer.objects.active = objects[0] if objects else None


def range_of_animation():
    """First and last frame of every action; the scene's if there is none."""
    ends = [tuple(a.frame_range) for a in bpy.data.actions]
    scene = bpy.context.scene
    if not ends:
        return scene.frame_start, scene.frame_end
    return int(min(a for a, _ in ends)), int(-(-max(b for _, b in ends) // 1))


def add_sticks(armature):
    """A skinned mesh with one octahedron for each bone."""
    vertices, faces, groups = [], [], {}
    for bone in armature.data.bones:
        first, head, tail = len(vertices), bone.head_local, bone.tail_local
        thick = max(bone.length * 0.1, 1e-4)
        side, up = bone.x_axis * thick, bone.z_axis * thick
        ring = head + (tail - head) * 0.2
        vertices += [head, ring + side, ring + up, ring - side, ring - up, tail]
        for k in range(4):
            a, b = first + 1 + k, first + 1 + (k + 1) % 4
            faces += [(first, b, a), (first + 5, a, b)]
        groups[bone.name] = range(first, first + 6)
    mesh = bpy.data.meshes.new("sticks")
    mesh.from_pydata([tuple(v) for v in vertices], [], faces)
    sticks = bpy.data.objects.new("sticks", mesh)
    bpy.context.scene.collection.objects.link(sticks)
    for name, members in groups.items():
        sticks.vertex_groups.new(name=name).add(list(members), 1.0, "REPLACE")
    sticks.modifiers.new("armature", "ARMATURE").object = armature
    sticks.parent = armature


def move_rig(rig_file, motion, frames):
    """Bones of the rig follow those of the same name, and their motion is written into them."""
    before = set(bpy.context.scene.objects)
    read(rig_file)
    rigs = [o for o in of_type("ARMATURE") if o not in before]
    if len(rigs) != 1:
        raise Refused(f"{rig_file}: {len(rigs)} skeletons, expected 1")
    rig, matched = rigs[0], 0
    rig.animation_data_clear()
    for bone in rig.pose.bones:
        if bone.name not in motion.pose.bones:
            continue
        matched += 1
        kinds = ("COPY_ROTATION",) if bone.parent else ("COPY_ROTATION", "COPY_LOCATION")
        for kind in kinds:
            constraint = bone.constraints.new(kind)
            constraint.target, constraint.subtarget = motion, bone.name
    if not matched:
        raise Refused(f"{rig_file}: no bone has the name of one in the motion")
    select_only([rig])
    bpy.ops.object.mode_set(mode="POSE")
    bpy.ops.nla.bake(frame_start=frames[0], frame_end=frames[1], only_selected=False, visual_keying=True,
                     clear_constraints=True, bake_types={"POSE"})
    bpy.ops.object.mode_set(mode="OBJECT")
    bpy.data.objects.remove(motion)
    print(f"blender_export: {matched} of {len(rig.pose.bones)} bones follow the motion")


def bake(target, frames):
    """The evaluated mesh of every frame as a shape key, on when its frame is."""
    scene, first = bpy.context.scene, None
    for frame in range(frames[0], frames[1] + 1):
        scene.frame_set(frame)
        shape = target.evaluated_get(bpy.context.evaluated_depsgraph_get())
        mesh = shape.to_mesh()
        points = [v.co.copy() for v in mesh.vertices]
        if first is None:
            baked = bpy.data.objects.new(target.name + "_baked", bpy.data.meshes.new_from_object(shape))
            scene.collection.objects.link(baked)
            baked.animation_data_clear()
            baked.shape_key_clear()
            baked.shape_key_add(name="Basis")
            first = len(points)
        shape.to_mesh_clear()
        if len(points) != first:
            raise Refused(f"{target.name}: {len(points)} vertices in frame {frame}, {first} in frame {frames[0]}")
        key = baked.shape_key_add(name=f"frame {frame}", from_mix=False)
        for k, point in enumerate(points):
            key.data[k].co = point
        for at, value in ((frame - 1, 0.0), (frame, 1.0), (frame + 1, 0.0)):
            if frames[0] <= at <= frames[1]:
                key.value = value
                key.keyframe_insert("value", frame=at)
    for curve in baked.data.shape_keys.animation_data.action.fcurves:
        for point in curve.keyframe_points:
            point.interpolation = "LINEAR"
    baked.parent, baked.matrix_parent_inverse = target.parent, target.matrix_parent_inverse.copy()
    baked.matrix_basis = target.matrix_basis.copy()
    if target.animation_data and target.animation_data.action:
        baked.animation_data_create().action = target.animation_data.action
    bpy.data.objects.remove(target)


def count_moving():
    """Things with an action: objects, and meshes by their shape keys."""
    keys = [o.data.shape_keys for o in of_type("MESH") if o.data.shape_keys]
    things = list(bpy.context.scene.objects) + keys
    return sum(bool(x.animation_data and x.animation_data.action) for x in things)


def write(path, frames, merge):
    scene = bpy.context.scene
    scene.frame_start, scene.frame_end = frames
    mode = {"export_nla_strips": not merge, "export_animation_mode": "ACTIVE_ACTIONS" if merge else "ACTIONS"}
    call(operator_of("export_scene.gltf"), filepath=path, export_format="GLB", export_yup=True, export_cameras=True,
         export_animations=True, export_force_sampling=True, export_frame_range=False, export_skins=True,
         export_all_influences=True, export_morph=True, export_morph_normal=True, export_apply=False,
         export_optimize_animation_size=False, export_draco_mesh_compression_enable=False, **mode)


def options():
    words = sys.argv[sys.argv.index("--") + 1:] if "--" in sys.argv else []
    p = argparse.ArgumentParser(prog="blender_export.py", usage=__doc__, add_help=False)
    p.add_argument("input")
    p.add_argument("-o", dest="output")
    p.add_argument("--rig")
    p.add_argument("--frames")
    p.add_argument("--fps", type=float)
    p.add_argument("--merge", action="store_true")
    p.add_argument("--bake", action="store_true")
    if not words or "-h" in words or "--help" in words:
        print(__doc__)
        raise SystemExit(0 if words else 2)
    return p.parse_args(words)


def frames_of(text):
    if not text:
        return range_of_animation()
    try:
        a, b = (int(x) for x in text.split(":"))
    except ValueError:
        a, b = 1, 0
    if a > b:
        raise Refused(f"--frames {text}: expected FIRST:LAST")
    return a, b


def main():
    o = options()
    output = o.output or os.path.splitext(o.input)[0] + ".glb"
    if os.path.abspath(output) == os.path.abspath(o.input):
        raise Refused(f"{output}: is the input; name another with -o")
    mend_blender()
    if not o.input.lower().endswith(".blend"):
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    read(o.input)
    frames = frames_of(o.frames)
    if o.input.lower().endswith(".bvh"):
        motion = of_type("ARMATURE")[0]
        if o.rig:
            move_rig(o.rig, motion, frames)
        else:
            add_sticks(motion)
    if o.fps:
        bpy.context.scene.render.fps = max(1, round(o.fps))
        bpy.context.scene.render.fps_base = bpy.context.scene.render.fps / o.fps
    for mesh in of_type("MESH"):
        if o.bake or any(m.type in OWN_MOTION for m in mesh.modifiers):
            bake(mesh, frames)
    if not of_type("MESH"):
        raise Refused(f"{o.input}: no meshes")
    write(output, frames, o.merge or count_moving() > 1)
    print(f"blender_export: {output}: frames {frames[0]} to {frames[1]}, {len(of_type('MESH'))} meshes")


if __name__ == "__main__":
    status = 1
    try:
        main()
        status = 0
    except Refused as e:
        print(f"blender_export: {e}", file=sys.stderr)
        status = 2
    except SystemExit as e:
        status = e.code if isinstance(e.code, int) else 2
    except Exception:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # Blender itself would answer 0
