"""The one door to pycolmap and to the files of other tools."""
