from surgical_marl.tasks.suture.task import Task as Task
