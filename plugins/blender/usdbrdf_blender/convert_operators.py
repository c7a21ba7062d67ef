"""The conversion in the background: settings, start, timer, cancel."""

import bpy

from .convert_job import DONE, RUNNING, ConvertJob
from .import_asset import import_asset
from .preferences import executable

_SECONDS_BETWEEN_LOOKS = 0.5

# At most one job at a time; it belongs to the session, not to the .blend file.
_job = None


def current_job():
    """The job that runs or ran last; None before the first."""
    return _job


class ConvertSettings(bpy.types.PropertyGroup):
    scan: bpy.props.StringProperty(
        name="Scan", description="Folder of the capture", subtype="DIR_PATH"
    )
    output: bpy.props.StringProperty(
        name="Asset", description="Folder to write; made if it is not there", subtype="DIR_PATH"
    )
    texel_size: bpy.props.FloatProperty(
        name="Texel Size",
        description="Edge of a texel in metres; 0: the capture's median pixel footprint",
        min=0.0,
        precision=4,
    )
    import_result: bpy.props.BoolProperty(
        name="Import Result", description="Import the asset when it is finished", default=True
    )


class USDBRDF_OT_convert(bpy.types.Operator):
    """Turn the scan into an asset, in the background; Blender stays usable"""

    bl_idname = "usdbrdf.convert"
    bl_label = "Convert"

    @classmethod
    def poll(cls, _context):
        return _job is None or _job.state != RUNNING

    def execute(self, context):
        global _job
        settings = context.window_manager.usdbrdf_convert
        if not settings.scan or not settings.output:
            self.report({"ERROR"}, "Name the scan's folder and the asset's.")
            return {"CANCELLED"}
        options = ["--texel-size", f"{settings.texel_size:g}"] if settings.texel_size else []
        folders = [bpy.path.abspath(folder) for folder in (settings.scan, settings.output)]
        _job = ConvertJob(executable(), *folders, options)
        if _job.state != RUNNING:
            self.report({"ERROR"}, _job.line)
            return {"CANCELLED"}
        bpy.app.timers.register(look_after_job)
        return {"FINISHED"}


class USDBRDF_OT_cancel(bpy.types.Operator):
    """Stop the conversion; converting into the same folder goes on from there"""

    bl_idname = "usdbrdf.cancel"
    bl_label = "Cancel"

    @classmethod
    def poll(cls, _context):
        return _job is not None and _job.state == RUNNING

    def execute(self, _context):
        _job.cancel()
        return {"FINISHED"}


def look_after_job():
    """Blender's timer: seconds until the next look, or None when there is nothing left to do."""
    if _job is None:
        return None
    state = _job.poll()
    _redraw()
    if state == RUNNING:
        return _SECONDS_BETWEEN_LOOKS
    if state == DONE and bpy.context.window_manager.usdbrdf_convert.import_result:
        import_asset(_job.asset)
    return None


def end_job():
    """Stop what still runs when the add-on goes."""
    global _job
    if bpy.app.timers.is_registered(look_after_job):
        bpy.app.timers.unregister(look_after_job)
    if _job is not None:
        _job.cancel()
    _job = None


def _redraw():
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()


CLASSES = (ConvertSettings, USDBRDF_OT_convert, USDBRDF_OT_cancel)
