from surgical_marl.tasks.camera_assist.task import Task as Task
