"""A double of the parts of usdview that plug-ins may use, without a window.

Names, signatures and what they do mirror OpenUSD 24.08, pxr/usdImaging/usdviewq: plugin.py,
usdviewApi.py, rootDataModel.py, viewSettingsDataModel.py and the order of appController.py, which
configures plug-ins before it opens the stage. Qt is reduced to what these files call on it.
"""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import ClassVar

from pxr import Plug, Sdf, Tf, Usd, UsdGeom

# plugin.py


class DuplicateCommandPlugin(Exception):
    pass


class DeferredImport:
    def __init__(self, moduleName, packageName=None):
        self._moduleName, self._packageName = moduleName, packageName

    def __getattr__(self, attr):
        def call(*args, **kwargs):
            module = importlib.import_module(self._moduleName, package=self._packageName)
            return getattr(module, attr)(*args, **kwargs)

        return call


class PluginContainer:
    def deferredImport(self, moduleName):
        return DeferredImport(moduleName, self.__module__)

    def registerPlugins(self, plugRegistry, plugCtx):
        raise NotImplementedError

    def configureView(self, plugRegistry, plugUIBuilder):
        raise NotImplementedError


class CommandPlugin:
    def __init__(self, name, displayName, callback, description, usdviewApi):
        self.name, self.displayName, self.description = name, displayName, description
        self._callback, self._usdviewApi = callback, usdviewApi

    def run(self):
        self._callback(self._usdviewApi)


class PluginRegistry:
    def __init__(self, usdviewApi):
        self._usdviewApi = usdviewApi
        self._commandPlugins = {}

    def registerCommandPlugin(self, name, displayName, callback, description=""):
        if name in self._commandPlugins:
            raise DuplicateCommandPlugin(name)
        plugin = CommandPlugin(name, displayName, callback, description, self._usdviewApi)
        self._commandPlugins[name] = plugin
        return plugin

    def getCommandPlugin(self, name):
        return self._commandPlugins.get(name, None)


class PluginMenu:
    def __init__(self, qMenu):
        self._qMenu = qMenu
        self._submenus = {}

    def addItem(self, commandPlugin, shortcut=None):
        action = self._qMenu.addAction(commandPlugin.displayName, lambda: commandPlugin.run())
        action.setToolTip(commandPlugin.description)
        return action

    def findOrCreateSubmenu(self, menuName):
        if menuName not in self._submenus:
            self._submenus[menuName] = PluginMenu(self._qMenu.addMenu(menuName))
        return self._submenus[menuName]

    def addSeparator(self):
        self._qMenu.addSeparator()


class PluginUIBuilder:
    def __init__(self, mainWindow):
        self._mainWindow = mainWindow
        self._menus = {}

    def findOrCreateMenu(self, menuName):
        if menuName not in self._menus:
            self._menus[menuName] = PluginMenu(self._mainWindow.addMenu(menuName))
        return self._menus[menuName]


def loadPlugins(usdviewApi, mainWindow):
    """Containers are found by libplug, as in plugin.py; they are not kept."""
    containers = []
    for container_type in Plug.Registry.GetAllDerivedTypes(Tf.Type.Find(PluginContainer)):
        Plug.Registry().GetPluginForType(container_type).Load()
        containers.append(container_type.pythonClass())
    return configure(containers, usdviewApi, mainWindow)


def configure(containers, usdviewApi, mainWindow):
    """The second half of loadPlugins."""
    registry = PluginRegistry(usdviewApi)
    for container in containers:
        container.registerPlugins(registry, usdviewApi)
    builder = PluginUIBuilder(mainWindow)
    for container in containers:
        container.configureView(registry, builder)
    return registry


# rootDataModel.py, viewSettingsDataModel.py, selectionDataModel.py


class Signal:
    def __init__(self):
        self._slots = []

    def connect(self, slot):
        self._slots.append(slot)

    def emit(self, *arguments):
        for slot in self._slots:
            slot(*arguments)


class ViewSettings:
    def __init__(self, root):
        self._root = root
        self.cameraPath = None

    @property
    def cameraPrim(self):
        return self._root.stage.GetPrimAtPath(self.cameraPath) if self.cameraPath else None

    @cameraPrim.setter
    def cameraPrim(self, value):
        assert value is None or value.IsA(UsdGeom.Camera)
        self.cameraPath = None if value is None else value.GetPrimPath()


class Selection:
    def __init__(self, root):
        self._root = root
        self._path = Sdf.Path.absoluteRootPath
        self.signalPrimSelectionChanged = Signal()

    def setPrim(self, prim):
        before, self._path = self._path, prim.GetPath()
        self.signalPrimSelectionChanged.emit({self._path}, {before})

    def getFocusPrim(self):
        return self._root.stage.GetPrimAtPath(self._path)


class DataModel:
    def __init__(self):
        self.signalStageReplaced = Signal()
        self.viewSettings = ViewSettings(self)
        self.selection = Selection(self)
        self._stage = None
        self._currentFrame = Usd.TimeCode.Default()

    @property
    def stage(self):
        return self._stage

    @stage.setter
    def stage(self, value):
        if value is not self._stage:
            self._stage = value
            self.signalStageReplaced.emit()

    @property
    def currentFrame(self):
        return self._currentFrame

    @currentFrame.setter
    def currentFrame(self, value):
        if not isinstance(value, Usd.TimeCode):
            raise ValueError(f"Expected Usd.TimeCode, got: {value}")
        self._currentFrame = value


# usdviewApi.py


class UsdviewApi:
    """``said`` and ``drawn`` are for tests; the rest is usdview's."""

    def __init__(self):
        self.dataModel = DataModel()
        self.qMainWindow = QMenu("main window")
        self.said = []
        self.drawn = 0

    @property
    def stage(self):
        return self.dataModel.stage

    @property
    def frame(self):
        return self.dataModel.currentFrame

    @property
    def prim(self):
        return self.dataModel.selection.getFocusPrim()

    @property
    def cameraPrim(self):
        return self.dataModel.viewSettings.cameraPrim

    def PrintStatus(self, msg):
        self.said.append(msg)

    def UpdateGUI(self):
        pass

    def UpdateViewport(self):
        self.drawn += 1


# Qt


class QAction:
    def __init__(self, text, callback):
        self.text, self.trigger, self.visible, self.tip = text, callback, True, ""

    def setToolTip(self, text):
        self.tip = text

    def setVisible(self, visible):
        self.visible = visible


class QMenu:
    def __init__(self, title):
        self.title, self.actions, self.menus = title, {}, {}

    def addAction(self, text, callback):
        self.actions[text] = QAction(text, callback)
        return self.actions[text]

    def addMenu(self, title):
        self.menus[title] = QMenu(title)
        return self.menus[title]

    def addSeparator(self):
        pass


class QMessageBox:
    shown: ClassVar[list[tuple[str, str]]] = []

    @classmethod
    def information(cls, parent, title, text):
        cls.shown.append((title, text))


def install():
    """Put the modules where a plug-in imports them from."""
    package, plugin, qt = (ModuleType(f"pxr.Usdviewq{name}") for name in ("", ".plugin", ".qt"))
    package.__path__ = []
    PluginContainer.__module__ = "pxr.Usdviewq.plugin"
    plugin.PluginContainer = PluginContainer
    qt.QtWidgets = ModuleType("QtWidgets")
    qt.QtWidgets.QMessageBox = QMessageBox
    sys.modules.update({m.__name__: m for m in (package, plugin, qt)})
    Tf.Type.Define(PluginContainer)
