"""The submenu with one entry per look of whatever stage is open."""

from functools import partial

from usdbrdf_usdview.looks import looks_of, switch_look


def keep_look_menu(submenu, plugRegistry, usdviewApi):
    """Fill the submenu now and whenever usdview opens another stage.

    A command cannot be registered twice and an entry cannot be taken away: entries stay, and are
    hidden while the stage has no look of their name.
    """
    entries = {}

    def refresh():
        looks = looks_of(usdviewApi.stage)
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
    refresh()


def _show(look, usdviewApi):
    switch_look(usdviewApi.stage, look)
    usdviewApi.PrintStatus(f"look: {look}")
