"""What the menu's entries do; usdview imports this when the first of them is chosen."""

from pxr.Usdviewq.qt import QtWidgets

from usdbrdf_usdview.fit_facts import (
    METHOD,
    TARGET_FRAME,
    capture_camera,
    facts_of,
    fitted_prim,
    time_code_of_frame,
)
from usdbrdf_usdview.fit_rows import fit_rows

_NOT_FITTED = "Select an object that usdbrdf has fitted."


def inspect(usdviewApi):
    """Show the selected object's fit in a dialog."""
    prim = fitted_prim(usdviewApi.prim)
    text = inspection(prim) if prim else _NOT_FITTED
    QtWidgets.QMessageBox.information(usdviewApi.qMainWindow, "usdbrdf", text)


def inspection(prim):
    """The dialog's text: path, then one line per fact."""
    rows = fit_rows(facts_of(prim))
    return "\n".join([str(prim.GetPath()), *(f"{label}: {value}" for label, value in rows)])


def jump_to_target_frame(usdviewApi):
    """Look through the capture camera at the photograph that the selected object's fit names."""
    prim = fitted_prim(usdviewApi.prim)
    if not prim:
        usdviewApi.PrintStatus(_NOT_FITTED)
        return
    facts, camera = facts_of(prim), capture_camera(usdviewApi.stage)
    frame = facts.get(TARGET_FRAME, -1)
    if frame < 0 or camera is None:
        method = facts.get(METHOD, "none")
        usdviewApi.PrintStatus(f"{prim.GetName()}: its fit ({method}) names no target frame.")
        return
    time = time_code_of_frame(frame)
    usdviewApi.dataModel.viewSettings.cameraPrim = camera
    usdviewApi.dataModel.currentFrame = time
    usdviewApi.UpdateGUI()
    usdviewApi.UpdateViewport()
    usdviewApi.PrintStatus(f"{prim.GetName()}: frame {frame}, time code {time.GetValue():g}")
