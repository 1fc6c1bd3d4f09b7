"""Storage: what is written to disk, whole and with its checksum.

============= ===================================================================================
files         files that are written whole or not at all; tables as CSV; locks of folders
artefacts     trained parts and checkpoints: safetensors, with their SHA-256 inside
signed        files that only this user can have written, by a keyed checksum
manifest      the SHA-256 of every file of a folder of results, and which settings it must share
measures      by what stored results are compared
child         a child process with limits of time and memory, which opens files of others first
torch_files   what others wrote: members of a zip, and the tensors of ``torch.save``, in bounds
============= ===================================================================================

Nothing here is pickled.
"""
