"""What is optimised beside the field: poses, intrinsics, rigid bodies, exposure. Takes no steps itself."""
