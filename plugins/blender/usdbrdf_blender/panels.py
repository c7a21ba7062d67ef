"""The tab "usdbrdf" at the right of the 3D view."""

import textwrap

import bpy

from .convert_job import CANCELLED, DONE, FAILED, RUNNING
from .convert_operators import USDBRDF_OT_cancel, USDBRDF_OT_convert, current_job
from .fit_rows import fit_rows
from .import_asset import USDBRDF_OT_import
from .import_hook import ROOT, SHOWN
from .switch_look import USDBRDF_MT_looks

STATUS = "usdBrdf:fit:status"
_WIDTH = 34  # letters that fit beside a label in the tab's usual width


class _Tab:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "usdbrdf"


class USDBRDF_PT_fit(_Tab, bpy.types.Panel):
    bl_idname = "USDBRDF_PT_fit"
    bl_label = "Measured Material"

    @classmethod
    def poll(cls, context):
        return context.object is not None and STATUS in context.object

    def draw(self, context):
        facts = context.object
        measured = facts[STATUS] == "measured"
        for label, value in fit_rows(facts):
            split = self.layout.split(factor=0.35)
            split.label(text=label)
            lines = split.column(align=True)
            # What is likely must not pass for a measurement.
            lines.alert = label == "Status" and not measured
            for line in textwrap.wrap(value, _WIDTH):
                lines.label(text=line)


class USDBRDF_PT_look(_Tab, bpy.types.Panel):
    bl_idname = "USDBRDF_PT_look"
    bl_label = "Look"

    @classmethod
    def poll(cls, context):
        return context.object is not None and ROOT in context.object

    def draw(self, context):
        self.layout.menu(USDBRDF_MT_looks.bl_idname, text=context.object[SHOWN])


class USDBRDF_PT_convert(_Tab, bpy.types.Panel):
    bl_idname = "USDBRDF_PT_convert"
    bl_label = "Convert a Scan"

    def draw(self, context):
        layout = self.layout
        settings = context.window_manager.usdbrdf_convert
        for name in ("scan", "output", "texel_size", "import_result"):
            layout.prop(settings, name)
        layout.operator(USDBRDF_OT_convert.bl_idname)
        job = current_job()
        if job is not None:
            if job.state == RUNNING:
                layout.operator(USDBRDF_OT_cancel.bl_idname)
            box = layout.box()
            box.alert = job.state == FAILED
            for line in job_lines(job):
                box.label(text=line)
        layout.operator(USDBRDF_OT_import.bl_idname)


def job_lines(job):
    """What the panel says of a job: how it stands, and its last line."""
    head = {RUNNING: "Running", DONE: "Done", FAILED: "Failed", CANCELLED: "Cancelled"}[job.state]
    return [head, *textwrap.wrap(job.line, _WIDTH + 14)]


CLASSES = (USDBRDF_PT_fit, USDBRDF_PT_look, USDBRDF_PT_convert)
