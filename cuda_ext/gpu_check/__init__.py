"""Everything that only a GPU can tell, in three jobs: `python3 -m cuda_ext.gpu_check`."""
