"""Script that Blender runs: convert a file that Blender reads to glb, or a glb to a format that Blender writes.

    blender --background --factory-startup --python convert.py -- INPUT OUTPUT
    python convert.py INPUT OUTPUT          # a Python that has the package bpy

INPUT is not trusted: its scripts and drivers do not run, memory and output are limited, and images and libraries
outside its folder are left out. Notes for the user go to stdout, in lines that begin with "note: ".
"""

import contextlib
import os
import sys

import bpy

MEMORY = 8 << 30  # bytes of address space
LARGEST = 1 << 32  # bytes of the output


def limit_resources():
    """Limit the memory and output of this process, where the system can."""
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_FSIZE, (LARGEST, LARGEST))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def note(text):
    print(f"note: {text}", flush=True)


def open_empty_scene():
    """Open an empty scene in which no file may run scripts."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.preferences.filepaths.use_scripts_auto_execute = False
    bpy.context.preferences.filepaths.use_file_compression = True


def operator(*names):
    """The first of the operators that this version of Blender has."""
    for name in names:
        group, _, member = name.partition(".")
        if member in dir(getattr(bpy.ops, group)):
            return getattr(getattr(bpy.ops, group), member)
    raise SystemExit(f"Blender {bpy.app.version_string} has no {names[-1]}")


def call(function, **options):
    """Call an operator with the options that this version of Blender knows."""
    known = function.get_rna_type().properties.keys()
    function(**{name: value for name, value in options.items() if name in known})


def read(path):
    suffix = os.path.splitext(path)[1].lower()
    if suffix == ".blend":
        bpy.ops.wm.open_mainfile(filepath=path, load_ui=False, use_scripts=False)
    elif suffix == ".fbx":
        call(operator("import_scene.fbx"), filepath=path, use_image_search=False, ignore_leaf_bones=False)
        strip_object_names()
    elif suffix == ".dae":
        call(operator("wm.collada_import"), filepath=path, keep_bind_info=True)
    elif suffix in (".usd", ".usda", ".usdc", ".usdz"):
        call(
            operator("wm.usd_import"), filepath=path, import_textures_mode="IMPORT_PACK", support_scene_instancing=False
        )
    else:
        call(operator("import_scene.gltf"), filepath=path, disable_bone_shape=True, guess_original_bind_pose=False)


def remove_external_files(folder):
    """Remove images and libraries that are missing or outside the folder of the file."""
    names = {}
    for kind in (bpy.data.libraries, bpy.data.images):
        for each in list(kind):
            if getattr(each, "packed_file", None) or getattr(each, "source", "FILE") not in (
                "FILE",
                "SEQUENCE",
                "TILED",
            ):
                continue
            real = os.path.realpath(bpy.path.abspath(each.filepath))
            inside = real.startswith(os.path.join(os.path.realpath(folder), ""))
            if not inside or not os.path.isfile(real.replace("<UDIM>", "1001")):
                names[os.path.basename(real)] = None
                kind.remove(each)
    if names:
        first = ", ".join(list(names)[:6]) + (", ..." if len(names) > 6 else "")
        note(f"left out files that are missing or outside its folder: {first}")


def rendered_meshes():
    """Objects with a mesh that are rendered, including the members of instanced collections."""
    found = list(bpy.context.scene.objects)
    for each in found:  # the list grows in the loop
        if each.instance_type == "COLLECTION" and each.instance_collection is not None and not each.hide_render:
            found += [other for other in each.instance_collection.all_objects if other not in found]
    return [each for each in found if each.type == "MESH" and not each.hide_render]


def hide_unrendered():
    """Hide objects of collections that are excluded from the scene's view layers, or from renders, such as the widgets
    of a rig.

    Exporters look at the flags of the objects alone. Issue a note on objects that only the viewport hides: these are
    exported.
    """
    layers = [each.layer_collection for each in bpy.context.scene.view_layers if each.use]
    rendered = set()
    for each in layers:  # the list grows in the loop
        if not each.exclude and not each.collection.hide_render:
            rendered.update(each.collection.objects)
            layers += each.children
    objects = list(bpy.context.scene.objects)
    for each in objects:
        if layers and each not in rendered:
            each.hide_render = True
    hidden = [each.name for each in objects if each.type == "MESH" and not each.hide_render and not each.visible_get()]
    if hidden:
        names = ", ".join(hidden[:4]) + (", ..." if len(hidden) > 4 else "")
        note(f"read as well, because renders show what only the view hides: {names} (--without leaves it out)")


def prepare():
    """Apply modifiers that the exporters would ignore: they apply none if any mesh has shape keys.

    Return whether the exporter shall apply modifiers itself.
    """
    with_shapes = [each for each in rendered_meshes() if each.data.shape_keys]
    modified = [each.name for each in with_shapes if any(one.type != "ARMATURE" for one in each.modifiers)]
    if modified:
        note(f"modifiers are left out of meshes with shape keys: {', '.join(modified[:4])}")
    if with_shapes:
        for each in rendered_meshes():
            if not each.data.shape_keys and not each.library:
                apply_modifiers(each)
    return not with_shapes


def apply_modifiers(item):
    """Replace an object's mesh by the result of its modifiers, except armature modifiers."""
    skeletons = [each for each in item.modifiers if each.type == "ARMATURE" and each.show_viewport]
    others = [each for each in item.modifiers if each.type != "ARMATURE"]
    if not others:
        return
    for each in skeletons:
        each.show_viewport = False
    graph = bpy.context.evaluated_depsgraph_get()
    mesh = bpy.data.meshes.new_from_object(item.evaluated_get(graph), preserve_all_data_layers=True, depsgraph=graph)
    mesh.name = item.data.name
    item.data = mesh
    for each in others:
        item.modifiers.remove(each)
    for each in skeletons:
        each.show_viewport = True


def report_polygons():
    """Report whether there are faces with more than three corners."""
    if any(face.loop_total > 3 for each in rendered_meshes() for face in each.data.polygons):
        print("with polygons", flush=True)


def image_above(socket):
    """The output socket of the first image texture upstream of a socket; None if there is none."""
    for link in socket.links:
        if link.from_node.type == "TEX_IMAGE":
            return link.from_socket
        for other in link.from_node.inputs:
            if (found := image_above(other)) is not None:
                return found
    return None


def strip_object_names():
    """Strip object names from the names of clips: fbx exporters prepend them, once for each export."""
    for action in list(bpy.data.actions):
        name = action.name
        for each in bpy.data.objects:
            while name.startswith(f"{each.name}|") and len(name) > len(each.name) + 1:
                name = name[len(each.name) + 1 :]
        action.name = name


def bind_clips():
    """Make each clip fit only the objects that play it.

    The fbx exporter writes a clip for every object that has the properties which the clip animates, and every object
    has a "location". Each clip gets a curve without keys, for a custom property that only its own objects have.
    """
    markers = {}
    for each in bpy.data.objects:
        data = each.animation_data
        if data is None:
            continue
        for user in (data, *(strip for track in data.nla_tracks for strip in track.strips)):
            if user.action is None:
                continue
            slot = getattr(user, "action_slot", None)  # since Blender 4.4
            marker = markers.setdefault((user.action.name, slot and slot.identifier), f"clip {len(markers)}")
            each[marker] = 0.0
            for curves in curves_of(user.action, slot):
                if curves.find(f'["{marker}"]') is None:
                    curves.new(f'["{marker}"]')


def curves_of(action, slot):
    """The collections of curves of an action."""
    if slot is None:
        return [action.fcurves]
    bags = [strip.channelbag(slot) for layer in action.layers for strip in layer.strips]
    return [bag.fcurves for bag in bags if bag is not None]


def note_lost_clips(suffix):
    """Issue a note on clips that a format cannot hold: clips of shape keys, or all clips but one."""
    names = {}
    if suffix == ".fbx":
        animations = [each.animation_data for each in bpy.data.shape_keys if each.animation_data is not None]
        for data in animations:
            names |= dict.fromkeys(track.name for track in data.nla_tracks)
            names |= {data.action.name: None} if data.action is not None else {}
        if names:
            note(
                f"an .fbx file holds no clips of shapes: {', '.join(list(names)[:6])}{', ...' if len(names) > 6 else ''}"
            )
        return
    for each in bpy.data.objects:
        data = each.animation_data
        if data is not None and data.action is not None:
            names |= dict.fromkeys([data.action.name, *(track.name for track in data.nla_tracks)])
    if len(names) > 1:
        note(f"a {suffix} file holds one clip: of {len(names)} only {next(iter(names))}")


def connect_images():
    """Connect images directly to their materials: exporters do not see them behind a multiplication by a color."""
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.use_nodes else ():
            if node.type == "BSDF_PRINCIPLED" and (image := image_above(node.inputs["Base Color"])) is not None:
                material.node_tree.links.new(image, node.inputs["Base Color"])


def new_packed_image(name, pixels, size):
    """Create an image that is packed into the file."""
    image = bpy.data.images.new(name, *size, is_data=True)
    image.pixels.foreach_set(pixels)
    image.update()
    image.pack()
    return image


def split_channels():
    """Give roughness and metalness, which glTF stores as channels of one image, separate images, as exporters expect."""
    import numpy as np

    images = {}
    for material in bpy.data.materials:
        for node in list(material.node_tree.nodes) if material.use_nodes else ():
            if node.type != "BSDF_PRINCIPLED":
                continue
            for socket, channel in (("Roughness", 1), ("Metallic", 2)):
                upstream = image_above(node.inputs[socket])
                if upstream is None or upstream.node.image is None:
                    continue
                image = upstream.node.image
                if (image.name, channel) not in images:
                    pixels = np.empty(len(image.pixels), np.float32)
                    image.pixels.foreach_get(pixels)
                    grey = pixels.reshape(-1, image.channels)[:, [min(channel, image.channels - 1)] * 4].copy()
                    grey[:, 3] = 1.0
                    images[image.name, channel] = new_packed_image(
                        f"{material.name} {socket.lower()}", grey.ravel(), image.size
                    )
                texture = material.node_tree.nodes.new("ShaderNodeTexImage")
                texture.image = images[image.name, channel]
                for link in upstream.node.inputs["Vector"].links:
                    material.node_tree.links.new(link.from_socket, texture.inputs["Vector"])
                material.node_tree.links.new(texture.outputs["Color"], node.inputs[socket])


def name_images():
    """Give packed images unique file names.

    The fbx exporter identifies images by their file names, and would merge all images without one.
    """
    taken = set()
    for image in bpy.data.images:
        if image.packed_file is None:
            continue
        stem = os.path.splitext(bpy.path.clean_name(image.name))[0] or "image"
        name = next(each for k in range(len(taken) + 1) if (each := f"{stem}-{k}" if k else stem) not in taken)
        taken.add(name)
        image.filepath_raw = f"//{name}.{'jpg' if image.file_format == 'JPEG' else 'png'}"


def note_lost_images(suffix):
    """Issue a note on images of materials that a format cannot hold."""
    lost = {}
    for material in bpy.data.materials:
        for node in material.node_tree.nodes if material.use_nodes else ():
            if node.type == "GROUP" and any(image_above(each) is not None for each in node.inputs):
                lost["occlusion"] = None
            elif node.type == "BSDF_PRINCIPLED" and suffix == ".dae":
                inputs = {
                    "Normal": "normals",
                    "Roughness": "roughness",
                    "Metallic": "metal",
                    "Emission Color": "emission",
                }
                lost |= {word: None for name, word in inputs.items() if image_above(node.inputs[name]) is not None}
    if lost:
        note(f"{'an' if suffix == '.fbx' else 'a'} {suffix} file holds no images of {', '.join(lost)}")


def write(path, apply):
    suffix = os.path.splitext(path)[1].lower()
    if suffix == ".glb":
        call(
            operator("export_scene.gltf"), filepath=path, export_format="GLB", export_yup=True, export_apply=apply,
            export_animations=True, export_skins=True, export_morph=True, export_all_influences=True,
            export_all_vertex_colors=False, export_tangents=False, export_extras=False, use_renderable=True,
            export_optimize_animation_size=False,
        )  # fmt: skip
    elif suffix == ".fbx":
        call(
            operator("export_scene.fbx"), filepath=path, path_mode="COPY", embed_textures=True, add_leaf_bones=False,
            bake_anim_use_all_bones=True, bake_anim_simplify_factor=0.0, use_mesh_modifiers=apply,
        )  # fmt: skip
    elif suffix == ".dae":
        stem = os.path.splitext(os.path.basename(path))[0]
        # a copy: renaming reorders the list; the files are written next to the dae, so they get its name
        for image in list(bpy.data.images):
            image.name = f"{stem}-{image.name}"
        call(operator("wm.collada_export"), filepath=path, use_texture_copies=True, apply_modifiers=apply)
    elif suffix == ".blend":
        bpy.ops.file.pack_all()
        bpy.ops.wm.save_as_mainfile(filepath=path, compress=True)
    else:
        call(
            operator("wm.usd_export"), filepath=path, export_animation=True, export_armatures=True,
            export_shapekeys=True, export_textures_mode="NEW", generate_preview_surface=True,
            convert_orientation=True,
        )  # fmt: skip


def main(source, output):
    limit_resources()
    open_empty_scene()
    read(source)
    hide_unrendered()
    if not rendered_meshes():
        raise SystemExit("there is no mesh in it")
    remove_external_files(os.path.dirname(source))
    suffix = os.path.splitext(output)[1].lower()
    if suffix == ".glb":
        report_polygons()
    else:
        connect_images()
    if suffix in (".fbx", ".usdz", ".dae"):
        note_lost_clips(suffix)
        note_lost_images(suffix)
    if suffix == ".fbx":
        bind_clips()
        split_channels()
        name_images()
    write(output, prepare())
    if not os.path.isfile(output):
        raise SystemExit("Blender wrote nothing")


def run():
    """Convert, and return the exit status. On failure the last line of output says why."""
    try:
        words = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
        main(*map(os.path.abspath, words))
    except BaseException as error:
        print(f"Error: {error}")
        return 1
    return 0


status = run()
sys.stdout.flush()
os._exit(status)  # Blender does not exit by itself after it refused a file's drivers
