# A rez package of the program: `rez build --install` in this folder, inside a checkout.
# ruff: noqa
name = "usdbrdf"
version = "0.1.0"
description = "Measured materials for captured rooms and objects, written as USD layers."
requires = ["python-3.10+<3.14"]
tools = ["usdbrdf"]
private_build_requires = ["pip"]
build_command = "python -m pip install --prefix {install_path} -c {root}/../../../constraints.txt {root}/../../.."


def commands():
    env.PATH.append("{root}/bin")
    site = "{root}/lib/python{resolve.python.version.major}.{resolve.python.version.minor}/site-packages"
    env.PYTHONPATH.append(site)
    env.PXR_PLUGINPATH_NAME.append(site + "/usdbrdf/schemas")
