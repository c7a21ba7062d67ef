"""A menu "usdbrdf" for usdview: looks, what was measured, and the photograph that shows it."""

from pxr import Tf
from pxr.Usdviewq.plugin import PluginContainer

from usdbrdf_usdview.look_menu import keep_look_menu


class UsdBrdfContainer(PluginContainer):
    """usdview makes one at its start, before it opens the stage."""

    def registerPlugins(self, plugRegistry, usdviewApi):
        self._api = usdviewApi
        commands = self.deferredImport(".commands")
        self._inspect = plugRegistry.registerCommandPlugin(
            "usdbrdf.inspect",
            "Inspect Fit of Selected Object",
            commands.inspect,
            "Roughness and specular with their errors, and whether they were measured",
        )
        self._jump = plugRegistry.registerCommandPlugin(
            "usdbrdf.jump",
            "Jump to Target Frame",
            commands.jump_to_target_frame,
            "Look through the capture camera at the frame that shows the highlight best",
        )

    def configureView(self, plugRegistry, plugUIBuilder):
        menu = plugUIBuilder.findOrCreateMenu("usdbrdf")
        keep_look_menu(menu.findOrCreateSubmenu("Look"), plugRegistry, self._api)
        menu.addSeparator()
        menu.addItem(self._inspect)
        menu.addItem(self._jump)


Tf.Type.Define(UsdBrdfContainer)
