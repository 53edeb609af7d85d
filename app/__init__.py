"""The nodeslam application: commands, task execution, evaluation, training, web viewer."""
