"""The submenu with one entry per look of the selected asset."""

from functools import partial

from usdbrdf_usdview.looks import look_prim, looks_of, switch_look


def keep_look_menu(submenu, plugRegistry, usdviewApi):
    """Fill the submenu now and whenever usdview opens another stage, or other prims are selected.

    A command cannot be registered twice and an entry cannot be taken away: entries stay, and are
    hidden while the asset has no look of their name.
    """
    entries = {}

    def refresh(*_selected):
        looks = looks_of(look_prim(usdviewApi))
        for look in looks:
            if look not in entries:
                command = plugRegistry.registerCommandPlugin(
                    f"usdbrdf.look.{look}",
                    look,
                    partial(_show, look),
                    f'Show the look "{look}"; nothing on disk is changed',
                )
                entries[look] = submenu.addItem(command)
        for look, entry in entries.items():
            entry.setVisible(look in looks)

    usdviewApi.dataModel.signalStageReplaced.connect(refresh)
    usdviewApi.dataModel.selection.signalPrimSelectionChanged.connect(refresh)
    refresh()


def _show(look, usdviewApi):
    prim = look_prim(usdviewApi)
    if look not in looks_of(prim):
        usdviewApi.PrintStatus(f"Select an asset that has the look {look}.")
        return
    switch_look(prim, look)
    usdviewApi.PrintStatus(f"{prim.GetName()}, look: {look}")
