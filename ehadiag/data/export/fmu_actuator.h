int32_t eha_plant_start(double *memory, double *values);
int32_t eha_plant_tick(double *memory, double *values);

static int32_t eha_start(double *memory, double *values)
{
    return eha_plant_start(memory, values);
}

static int32_t eha_tick_once(double *memory, double *values)
{
    return eha_plant_tick(memory, values);
}
