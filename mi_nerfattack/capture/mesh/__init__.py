"""Meshes with textures: glTF, OBJ, PLY, surfaces, atlases."""
