"""The project's own outputs: poses.json and scene.glb. Nothing reads them back."""
