from surgical_marl.tasks.needle_drive.task import Task as Task
