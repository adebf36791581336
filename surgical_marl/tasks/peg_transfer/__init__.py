from surgical_marl.tasks.peg_transfer.task import Task as Task
