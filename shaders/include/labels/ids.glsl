// Instance id; 0: nothing hit.
uniform uint instance_id;

uint label_ids()
{
    return instance_id;
}
