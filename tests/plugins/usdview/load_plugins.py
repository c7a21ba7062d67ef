"""usdview's start in a process of its own: libplug finds the plug-in, then a stage is opened.

load_plugins.py ASSET.usda    prints the titles of the menus, and the looks, as JSON
"""

import json
import sys

from fake_usdview import UsdviewApi, install, loadPlugins
from pxr import Usd

install()
api = UsdviewApi()
loadPlugins(api, api.qMainWindow)
api.dataModel.stage = Usd.Stage.Open(sys.argv[1])
menu = api.qMainWindow.menus["usdbrdf"]
print(json.dumps({"entries": list(menu.actions), "looks": list(menu.menus["Look"].actions)}))
