"""Files that somebody else made: the one place where foreign meshes, USD, COLMAP's models and
single pictures are parsed.

Their parsers are large, and a crafted or damaged file can make them crash, hang or ask for any
amount of memory. So each file is refused by its size before it is opened, and read in a child
process within limits of time and memory (``bounds.LIMITS``); what it names must lie beside it or in
folders that the user allows. A child is no sandbox: it has the rights of the user.

The frames of a capture do not come through here. They are hundreds of large files that threads
decode as fast as the disk gives them, again and again; a process for each, and a second copy of
each on its way back, would cost more than the decoding. OpenImageIO reads them in-process behind
the limits of ``files.images``, which admits five formats and bounds what is made of a file.
"""
