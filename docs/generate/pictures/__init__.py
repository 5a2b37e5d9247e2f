"""Pictures of docs/pictures: drawn from the code, from a made scene that is refined, or taken of the page."""
