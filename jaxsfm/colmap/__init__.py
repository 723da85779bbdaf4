"""The one door to pycolmap and to the files of other tools.

zlib and cv2 are imported before pycolmap on purpose. pycolmap 4.2.1 brings a zlib of its own. If
that one is loaded first, every later deflate (zlib.compress, PNG by OpenCV or Pillow) corrupts the
heap (measured). `import jaxsfm` loads zlib. Pillow's PNG encoder can fail even so, and is not used.
"""

import cv2  # noqa: F401  must precede pycolmap, see above
import pycolmap  # here, so that signals are noted again right after it

from jaxsfm.io import interrupt

interrupt.note_again()
pycolmap.logging.minloglevel = 3  # errors are raised too, and our messages are one sentence
