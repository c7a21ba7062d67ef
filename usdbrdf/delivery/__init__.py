"""The asset as one file to hand over: USDZ, or glTF for what reads no USD."""
