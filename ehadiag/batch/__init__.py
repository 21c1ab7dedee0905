"""Many recordings in one call: workers, a journal that resumes, and files of all results."""
