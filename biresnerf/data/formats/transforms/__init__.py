"""transforms.json as nerfstudio, instant-ngp and Blender write it: read and written."""
