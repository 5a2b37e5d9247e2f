"""The pictures of docs/pictures: drawn from code, made by refining a synthetic scene, or screenshots."""
