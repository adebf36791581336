from surgical_marl.tasks.thread_ring.task import Task as Task
