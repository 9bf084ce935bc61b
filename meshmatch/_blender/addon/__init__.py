"""Blender add-on: transfers between a source object and a target object.

The objects are exported as glb or ply files to a temporary folder, the program meshmatch runs on them in a separate
process, and its result is imported next to the target.
"""

import contextlib
import os
import re
import shutil
import subprocess
import tempfile

import bpy
import mathutils
import numpy as np

JOBS = {  # verb: button label, tooltip, and file name of the result
    "transfer-texture": ("Texture", "The target with the colors, or all material maps, of the source", "result.glb"),
    "transfer-rig": ("Rig", "The target with the armature, weights and actions of the source", "result.glb"),
    "transfer-weights": ("Weights", "Vertex groups of the source, on the target itself", "result.npz"),
    "transfer-shapes": ("Shape keys", "The target with the shape keys of the source", "result.glb"),
    "transfer-garment": ("Garment", "The garment of the source, fitted to the target", "result.glb"),
    "wrap": ("Wrap", "The mesh of the source, fitted to the surface of the target", "result.glb"),
    "match": ("Match", "An attribute of the source: the matching target vertex for each vertex", "result.npz"),
}
# Verbs with one result per vertex: the target is exported as ply, which keeps the order of vertices and splits no seams.
IN_ORDER = ("match", "transfer-weights")
SECONDS_TO_END = 5


class Trouble(Exception):
    """An error that the user can correct."""


def environment():
    """Environment variables without those that Blender sets for its own Python."""
    return {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}


class Process:
    """A meshmatch process that works in a folder."""

    def __init__(self, command, words, folder):
        program = shutil.which(bpy.path.abspath(command) if command.startswith("//") else os.path.expanduser(command))
        if program is None:
            raise Trouble(
                f"There is no program {command}: pip install meshmatch, and name it in the add-on's preferences"
            )
        self.log = open(os.path.join(folder, "log.txt"), "w+", encoding="utf-8", errors="replace")  # noqa: SIM115
        self.running = subprocess.Popen(
            [program, *words], cwd=folder, env=environment(), stdin=subprocess.DEVNULL, stdout=self.log,
            stderr=subprocess.STDOUT,
        )  # fmt: skip

    def lines(self):
        with open(self.log.name, encoding="utf-8", errors="replace") as file:
            return [line.strip() for line in file if line.strip()]

    def progress(self):
        """The last line of output, and the share (0..1) that it contains, else 0."""
        line = (self.lines() or [""])[-1]
        share = re.search(r"(\d+) %", line)
        return line, int(share[1]) / 100 if share else 0.0

    def cancel(self):
        self.running.terminate()  # on this signal meshmatch removes incomplete files
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.running.wait(SECONDS_TO_END)
        self.running.kill()
        self.running.wait()
        self.log.close()

    def finish(self):
        """Wait for the process; return the lines of its output, or raise `Trouble` if it failed."""
        status = self.running.wait()
        self.log.close()
        lines = self.lines()
        if status:
            errors = [line for line in lines if line.startswith(("error:", "Error"))] or lines[-1:]
            hints = [line for line in lines if line.startswith("hint:")]
            raise Trouble(" ".join([*errors[-1:], *hints[-1:]]) or f"meshmatch ended with status {status}")
        return lines


@contextlib.contextmanager
def selected(item):
    """Select only an object, its armature and the children of that; restore the selection afterwards."""
    layer = bpy.context.view_layer
    before, active = [each for each in layer.objects if each.select_get()], layer.objects.active
    armature = item.find_armature() or item
    for each in layer.objects:
        each.select_set(each in (item, armature) or (item.type == "ARMATURE" and each in item.children_recursive))
    layer.objects.active = item
    try:
        yield
    finally:
        for each in layer.objects:
            each.select_set(each in before)
        layer.objects.active = active


def write(item, path):
    with selected(item):
        if path.endswith(".ply"):
            bpy.ops.wm.ply_export(
                filepath=path, export_selected_objects=True, apply_modifiers=False, export_uv=False,
                export_normals=False, export_colors="NONE",
            )  # fmt: skip
        else:
            bpy.ops.export_scene.gltf(filepath=path, use_selection=True, export_apply=False, export_all_influences=True)


class Job:
    """One verb applied to the chosen objects, from export to import."""

    def __init__(self, verb, source, target, garment, command):
        if source is None or target is None or source == target:
            raise Trouble("Choose two different objects, a source and a target")
        if verb == "transfer-garment" and garment is None:
            raise Trouble("Choose the garment that sits on the source")
        if verb in IN_ORDER and (target.type != "MESH" or (verb == "match" and source.type != "MESH")):
            raise Trouble("Choose meshes: the result is one value for each of their vertices")
        self.verb, self.source, self.target, self.result = verb, source, target, JOBS[verb][2]
        self.folder = tempfile.mkdtemp(prefix="meshmatch-")
        try:
            in_order = verb in IN_ORDER
            files = {"source.ply" if verb == "match" else "source.glb": source}
            files["target.ply" if in_order else "target.glb"] = target
            if verb == "transfer-garment":
                files = {"garment.glb": garment} | files
            for name, item in files.items():
                write(item, os.path.join(self.folder, name))
            self.process = Process(command, [verb, *files, "-o", self.result], self.folder)
        except BaseException:
            self.remove()
            raise

    def remove(self):
        shutil.rmtree(self.folder, ignore_errors=True)

    def cancel(self):
        self.process.cancel()
        self.remove()

    def finish(self):
        """Import the result into the scene, and return the last line of meshmatch's output."""
        try:
            lines = self.process.finish()
            path = os.path.join(self.folder, self.result)
            if self.verb == "match":
                self.store_match(np.load(path))
            elif self.verb == "transfer-weights":
                self.store_weights(np.load(path))
            else:
                self.place(path)
            return lines[-1] if lines else "done"
        finally:
            self.remove()

    def store_match(self, arrays):
        for name, kind, values in (
            ("meshmatch_vertex", "INT", arrays["index"].astype(np.int32)),
            ("meshmatch_confidence", "FLOAT", arrays["confidence"].astype(np.float32)),
        ):
            attributes = self.source.data.attributes
            if name in attributes:
                attributes.remove(attributes[name])
            attributes.new(name, kind, "POINT").data.foreach_set("value", values)

    def store_weights(self, arrays):
        joints, weights = arrays["joints"], arrays["weights"]
        for number, name in enumerate(arrays["names"].tolist()):
            rows, columns = np.nonzero((joints == number) & (weights > 0))
            if len(rows):
                groups = self.target.vertex_groups
                group = groups.get(name) or groups.new(name=name)
                for row, weight in zip(rows.tolist(), weights[rows, columns].tolist(), strict=True):
                    group.add([row], weight, "REPLACE")

    def place(self, path):
        """Import the result next to the target, or to the previous result, shifted by 1.2 times the target's width."""
        before = set(bpy.data.objects)
        place = 1 + sum(each.get("meshmatch_of") == self.target.name for each in before)
        known = bpy.ops.import_scene.gltf.get_rna_type().properties.keys()
        options = {"disable_bone_shape": True} if "disable_bone_shape" in known else {}
        bpy.ops.import_scene.gltf(filepath=path, **options)
        imported = [each for each in bpy.data.objects if each not in before]
        corners = [self.target.matrix_world @ mathutils.Vector(corner) for corner in self.target.bound_box]
        width = max(each.x for each in corners) - min(each.x for each in corners)
        for each in imported:
            if each.parent is None:
                each.location.x += 1.2 * width * place
                each["meshmatch_of"] = self.target.name


class MeshmatchRun(bpy.types.Operator):
    """Run meshmatch on the chosen objects; Esc stops it"""

    bl_idname = "meshmatch.run"
    bl_label = "Run meshmatch"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012

    verb: bpy.props.EnumProperty(items=[(verb, label, words) for verb, (label, words, _) in JOBS.items()])

    @classmethod
    def description(cls, context, properties):
        return JOBS[properties.verb][1]

    def begin(self, context):
        chosen = context.scene.meshmatch
        command = context.preferences.addons[__package__].preferences.command
        return Job(self.verb, chosen.source, chosen.target, chosen.garment, command)

    def execute(self, context):
        """Run and wait, in scripts and without a window."""
        try:
            self.report({"INFO"}, self.begin(context).finish())
        except Trouble as trouble:
            self.report({"ERROR"}, str(trouble))
            return {"CANCELLED"}
        return {"FINISHED"}

    def invoke(self, context, event):
        try:
            self.job = self.begin(context)
        except Trouble as trouble:
            self.report({"ERROR"}, str(trouble))
            return {"CANCELLED"}
        self.timer = context.window_manager.event_timer_add(0.3, window=context.window)
        context.window_manager.modal_handler_add(self)
        self.show(context, "starting", 0.0)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        chosen = context.scene.meshmatch
        if event.type == "ESC" or chosen.stop:
            self.end(context)
            self.job.cancel()
            self.report({"INFO"}, "meshmatch was stopped")
            return {"CANCELLED"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        if self.job.process.running.poll() is None:
            self.show(context, *self.job.process.progress())
            return {"RUNNING_MODAL"}
        self.end(context)
        try:
            self.report({"INFO"}, self.job.finish())
        except Trouble as trouble:
            self.report({"ERROR"}, str(trouble))
            return {"CANCELLED"}
        return {"FINISHED"}

    def show(self, context, words, share):
        chosen = context.scene.meshmatch
        chosen.working, chosen.stop, chosen.words, chosen.share = True, False, words, share
        for area in context.screen.areas if context.screen else ():
            area.tag_redraw()

    def end(self, context):
        context.window_manager.event_timer_remove(self.timer)
        self.show(context, "", 0.0)
        context.scene.meshmatch.working = False


class MeshmatchStop(bpy.types.Operator):
    """Stop meshmatch"""

    bl_idname = "meshmatch.stop"
    bl_label = "Stop"

    def execute(self, context):
        context.scene.meshmatch.stop = True
        return {"FINISHED"}


def is_mesh_or_armature(_, item):
    return item.type in ("MESH", "ARMATURE")


class MeshmatchChoice(bpy.types.PropertyGroup):
    source: bpy.props.PointerProperty(type=bpy.types.Object, name="Source", poll=is_mesh_or_armature)
    target: bpy.props.PointerProperty(type=bpy.types.Object, name="Target", poll=is_mesh_or_armature)
    garment: bpy.props.PointerProperty(type=bpy.types.Object, name="Garment", poll=is_mesh_or_armature)
    working: bpy.props.BoolProperty(options={"SKIP_SAVE"})
    stop: bpy.props.BoolProperty(options={"SKIP_SAVE"})
    words: bpy.props.StringProperty(options={"SKIP_SAVE"})
    share: bpy.props.FloatProperty(options={"SKIP_SAVE"})


class MESHMATCH_PT_panel(bpy.types.Panel):
    bl_label = "meshmatch"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "meshmatch"

    def draw(self, context):
        chosen, layout = context.scene.meshmatch, self.layout
        for name in ("source", "target"):
            layout.prop(chosen, name)
        if chosen.working:
            layout.progress(factor=chosen.share, text=chosen.words)
            layout.operator("meshmatch.stop", icon="CANCEL")
            return
        column = layout.column(align=True)
        for verb, (label, _, _) in JOBS.items():
            if verb == "transfer-garment":
                column.prop(chosen, "garment")
            column.operator("meshmatch.run", text=label).verb = verb


class MeshmatchPreferences(bpy.types.AddonPreferences):
    bl_idname = __package__

    command: bpy.props.StringProperty(
        name="meshmatch", description="The program meshmatch: its path, or its name if it is on the path",
        default="meshmatch", subtype="FILE_PATH",
    )  # fmt: skip

    def draw(self, context):
        self.layout.prop(self, "command")


CLASSES = (MeshmatchChoice, MeshmatchRun, MeshmatchStop, MESHMATCH_PT_panel, MeshmatchPreferences)


def register():
    for each in CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.meshmatch = bpy.props.PointerProperty(type=MeshmatchChoice)


def unregister():
    del bpy.types.Scene.meshmatch
    for each in reversed(CLASSES):
        bpy.utils.unregister_class(each)
