"""Script for Blender: import files, count and measure their contents, and render them at rest and moved.

    python look.py PICTURES FILE ...

It prints a line of JSON for each file, and writes PICTURES/NAME-blender.png and NAME-blender-moved.png.
"""

import json
import math
import os
import sys

import bpy
from mathutils import Vector

SIZE, SAMPLES = 300, 16
IMPORTERS = {
    ".glb": ("import_scene.gltf", {"disable_bone_shape": True, "guess_original_bind_pose": False}),
    ".fbx": ("import_scene.fbx", {}),
    ".usdz": ("wm.usd_import", {}),
    ".dae": ("wm.collada_import", {}),
    ".obj": ("wm.obj_import", {}),
    ".ply": ("wm.ply_import", {"forward_axis": "NEGATIVE_Z", "up_axis": "Y"}),
}


def read(path):
    suffix = os.path.splitext(path)[1].lower()
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)
        return
    bpy.ops.wm.read_factory_settings(use_empty=True)
    name, options = IMPORTERS[suffix]
    group, _, own = name.partition(".")
    operator = getattr(getattr(bpy.ops, group), own)
    known = operator.get_rna_type().properties.keys()
    operator(filepath=path, **{key: value for key, value in options.items() if key in known})


def meshes():
    return [each for each in bpy.context.scene.objects if each.type == "MESH" and not each.hide_render]


def animated():
    """Return objects and shape keys with animation data."""
    found = list(bpy.context.scene.objects)
    found += [each.data.shape_keys for each in meshes() if each.data.shape_keys]
    return [each for each in found if each.animation_data]


def clips():
    """Return clips by name, of the NLA track or the action: (animated object or shape keys, action, slot) of each."""
    found = {}
    for each in animated():
        data = each.animation_data
        for track in data.nla_tracks:
            for strip in track.strips:
                if strip.action:
                    found.setdefault(track.name, []).append((each, strip.action, getattr(strip, "action_slot", None)))
        if data.action and not any(data.action == act for them in found.values() for _, act, _ in them):
            found.setdefault(data.action.name, []).append((each, data.action, getattr(data, "action_slot", None)))
    used = {action for them in found.values() for _, action, _ in them}
    for action in bpy.data.actions:  # of the clips of an fbx only one is assigned to the skeleton
        if action not in used and found:
            first = next(iter(found.values()))[0]
            found[action.name] = [(first[0], action, next(iter(getattr(action, "slots", ())), None))]
    return found


def box():
    """Return the bounding box of the visible meshes, in the axes of glTF."""
    graph = bpy.context.evaluated_depsgraph_get()
    low, high = [math.inf] * 3, [-math.inf] * 3
    for each in meshes():
        there = each.evaluated_get(graph)
        mesh = there.to_mesh()
        for vertex in mesh.vertices:
            x, y, z = there.matrix_world @ vertex.co
            for k, value in enumerate((x, z, -y)):
                low[k], high[k] = min(low[k], value), max(high[k], value)
        there.to_mesh_clear()
    return [low, high]


def count_contents():
    found = [each for each in meshes() if each.data.shape_keys]
    keys = sum(len(each.data.shape_keys.key_blocks) - 1 for each in found)
    bones = {bone.name for each in bpy.context.scene.objects if each.type == "ARMATURE" for bone in each.data.bones}
    images = [each for each in bpy.data.images if each.users and each.type == "IMAGE"]
    return {
        "meshes": len(meshes()),
        "faces": sum(len(each.data.polygons) for each in meshes()),
        "bones": sorted(bones),
        "clips": sorted(clips()),
        "morphs": keys,
        "images": sum(1 for each in images if each.has_data or each.size[0]),
        "images_missing": sum(1 for each in images if not each.size[0]),
        "colors": sum(len(each.data.color_attributes) > 0 for each in meshes()),
        "box": box(),
    }


def set_up_scene(corners):
    """Set up a camera, front left, and lights for a bounding box in the axes of glTF."""
    scene = bpy.context.scene
    for each in [each for each in scene.objects if each.type in ("CAMERA", "LIGHT")]:
        bpy.data.objects.remove(each)
    (x0, y0, z0), (x1, y1, z1) = corners
    low, high = Vector((x0, -z1, y0)), Vector((x1, -z0, y1))
    middle, far = (low + high) / 2, max((high - low).length, 1e-6)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.type, camera.data.ortho_scale = "ORTHO", 1.05 * far
    camera.data.clip_start, camera.data.clip_end = 0.01 * far, 10 * far
    toward = Vector((-0.5, -1.0, 0.25)).normalized()
    camera.location = middle + 3 * far * toward
    camera.rotation_euler = toward.to_track_quat("Z", "Y").to_euler()
    scene.collection.objects.link(camera)
    scene.camera = camera
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.use_shadow = 1.5, False
    sun.rotation_euler = Vector((-0.8, -1.0, 1.0)).normalized().to_track_quat("Z", "Y").to_euler()
    scene.collection.objects.link(sun)
    world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.4, 0.4, 0.4, 1.0)
    scene.world = world


def render(path):
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.samples, scene.cycles.use_denoising = "CYCLES", SAMPLES, False
    scene.cycles.max_bounces, scene.cycles.seed = 2, 0
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    scene.render.film_transparent, scene.render.filepath = True, path
    scene.render.image_settings.file_format, scene.render.image_settings.color_mode = "PNG", "RGBA"
    bpy.ops.render.render(write_still=True)


def move():
    """Set the middle of the first clip and the first shape key of each mesh; return whether there is any."""
    playing = clips()
    for name in sorted(playing)[:1]:
        start, stop = playing[name][0][1].frame_range
        for each, action, slot in playing[name]:
            data = each.animation_data
            for track in data.nla_tracks:
                track.mute = True
            data.action = action
            if slot is not None:
                data.action_slot = slot
        bpy.context.scene.frame_set(int(start + 0.5 * (stop - start)))
    keyed = [each for each in meshes() if each.data.shape_keys and len(each.data.shape_keys.key_blocks) > 1]
    for each in keyed:
        each.data.shape_keys.key_blocks[1].value = 1.0
    bpy.context.view_layer.update()
    return bool(playing or keyed)


def inspect_file(path, pictures):
    read(path)
    if not meshes():
        raise ValueError("there is no mesh in it")
    skeletons = [each for each in bpy.context.scene.objects if each.type == "ARMATURE"]
    for each in skeletons:  # otherwise the first frame of a clip is shown
        each.data.pose_position = "REST"
    bpy.context.view_layer.update()
    found = count_contents()
    stem = os.path.join(pictures, os.path.basename(path))
    set_up_scene(found["box"])
    render(f"{stem}-blender.png")
    for each in skeletons:
        each.data.pose_position = "POSE"
    if move():
        found["box_moved"] = box()
        set_up_scene(found["box_moved"])
        render(f"{stem}-blender-moved.png")
    return found


words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
output = os.fdopen(os.dup(1), "w")
os.dup2(2, 1)  # Blender's own output goes to stderr
for each in words[1:]:
    try:
        record = inspect_file(each, words[0])
    except Exception as error:
        record = {"error": str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__}
    print(json.dumps({"file": each} | record), file=output, flush=True)
os._exit(0)
