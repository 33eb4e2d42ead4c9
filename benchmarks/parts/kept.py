"""Results on disk, so that a run that was interrupted goes on where it was."""

import json


class Kept:
    """Calls work, or returns what it returned in an earlier run; anything JSON can hold."""

    def __init__(self, folder=None):
        self.folder = folder

    def __call__(self, name, work):
        if self.folder is None:
            return work()
        path = self.folder / f"{name}.json"
        if not path.exists():
            self.folder.mkdir(parents=True, exist_ok=True)
            partial = path.with_suffix(".part")
            partial.write_text(json.dumps(work(), default=lambda number: number.item()))
            partial.replace(path)
        return json.loads(path.read_text())
