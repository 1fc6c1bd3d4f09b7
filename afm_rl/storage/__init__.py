"""Storage: what is written to disk, whole and with its checksum.

============= ===================================================================================
files         files that are written whole or not at all; locks of folders
artefacts     trained parts: safetensors, with the SHA-256 of tensors and description inside
checkpoints   the last states of missions under way, stored as artefacts
manifest      the SHA-256 of every file of a folder of results, written last
settings      which settings stored results must share with those who ask for them
measures      by what stored results are compared
csv_text      tables as CSV
============= ===================================================================================

Nothing here is pickled.
"""
