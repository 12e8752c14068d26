"""A hub without a network."""

import shutil
from pathlib import Path
from typing import Any

from huggingface_hub.errors import EntryNotFoundError


class Hub:
    """Of the Hugging Face Hub, what one repository has."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.log: list[str] = []

    def create_repo(self, repo_id: str, private: bool, exist_ok: bool) -> Any:
        assert exist_ok
        self.log.append(f"{repo_id}, private: {private}")
        self.folder.mkdir(exist_ok=True)
        return type("RepoUrl", (str,), {"repo_id": repo_id})(f"https://hub/{repo_id}")

    def upload_folder(
        self, repo_id: str, folder_path: Path, allow_patterns: list[str], delete_patterns: list[str], commit_message: str
    ) -> None:
        for name in delete_patterns:
            (self.folder / name).unlink(missing_ok=True)
        for path in folder_path.iterdir():
            if path.name in allow_patterns:
                shutil.copy(path, self.folder)

    def download(self, repo_id: str, filename: str) -> str:
        if not (self.folder / filename).exists():
            raise EntryNotFoundError(f"404 Client Error.\n\nEntry Not Found for {repo_id}/{filename}.")
        return str(self.folder / filename)
